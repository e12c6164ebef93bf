"""LightningDataModule of the prior network: stacks synthesised on the fly."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from data_synth.data_module import VALIDATION_SEED, SyntheticDataModule
from data_synth.heads import USUAL_WEEKS, phantom_subjects
from data_synth.prior_samples import Patches, SyntheticSubjects
from data_synth.subject_dataset import EpochSampler
from data_synth.template import atlas_templates
from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.errors import InputError

MIXED_SUBJECTS = 4
"""Number of subjects whose patches are shuffled together."""


class StackSynthesisDataModule(SyntheticDataModule):
    """Patches of a subject's volumes from an atlas folder or the built-in phantom.

    A batch is a dict of float32 tensors [B, 1, I, J, K] with the keys `coarse`, `density`, `share`, `sharp`,
    `template`, `outline`, `truth` and `mask`, `n_stacks`, int64 [B], and `thickness_mm`, float32 [B].

    Args:
        phantom_share: share (0 to 1) of phantoms among the training subjects of an atlas folder.
        spacing_mm: isotropic voxel size.
        patch_size: edge of a training patch in voxels.
        patches_per_subject: patches cut from each synthetic subject.
        batch_size: patches per training batch.
        subjects_per_epoch: synthetic subjects per epoch.
        val_subjects: validation volumes.
        val_crop: edge in voxels of the central cube used for validation.
        artefact_share: probability that a slice has an artefact from its own acquisition: motion while its k-space
            is filled, ghosts or a spike (`data_synth.artefacts`); 0 for none.
        distinct_epochs: number of epochs after which the same subjects are repeated, with other patches; 0 for never.
        cache: folder that stores synthetic subjects (about 15 MB each); None stores none.
        template_spacing_mm: voxel size of the atlas template.
        common: see `SyntheticDataModule`.

    Raises:
        InputError: a setting out of range, no such folder, or nothing in it passes the patterns.
    """

    def __init__(
        self,
        phantom_share: float = 0.0,
        spacing_mm: float = 0.8,
        patch_size: int = 64,
        patches_per_subject: int = 8,
        batch_size: int = 4,
        subjects_per_epoch: int = 32,
        val_subjects: int = 4,
        val_crop: int = 96,
        artefact_share: float = 0.02,
        distinct_epochs: int = 0,
        cache: str | None = None,
        template_spacing_mm: float = 1.6,
        **common: Any,
    ) -> None:
        super().__init__(**common)
        self.check_at_least_one(
            "patch_size", "patches_per_subject", "batch_size", "subjects_per_epoch", "val_subjects", "val_crop"
        )
        if not 0 <= phantom_share < 1:
            raise InputError(f"data.phantom_share: {phantom_share:g}; expected 0 to below 1")
        if not 0 <= artefact_share <= 1:
            raise InputError(f"data.artefact_share: {artefact_share:g}; expected 0 to 1")
        if batch_size > patches_per_subject * subjects_per_epoch:
            raise InputError(
                f"data.batch_size: {batch_size}, but an epoch has {patches_per_subject * subjects_per_epoch} "
                "patches; raise subjects_per_epoch"
            )
        self.spacing_mm = spacing_mm
        self._template: AtlasTemplate | None = None

    def template(self) -> AtlasTemplate:
        """The atlas template of the training subjects, which is stored with the network."""
        if self._template is None:
            self._template = atlas_templates(
                self.subjects(self.hparams["val_subjects"])[0],
                self.hparams["template_spacing_mm"],
                unknown_weeks=USUAL_WEEKS,
            )
        return self._template

    def make_sets(self) -> tuple[SyntheticSubjects, SyntheticSubjects]:
        """Training patches, from new subjects in each epoch, and central cubes of fixed validation subjects."""
        h: Any = self.hparams
        train, val = self.subjects(h.val_subjects)
        template = self.template()
        n_phantoms = round(len(train) * h.phantom_share / (1 - h.phantom_share)) if h.source != "phantom" else 0
        # spread over the names, which mostly sort by age
        validated = [val[int(k)] for k in np.linspace(0, len(val) - 1, min(h.val_subjects, len(val))).round()]
        common = {"spacing_mm": h.spacing_mm, "artefact_share": h.artefact_share, "cache": h.cache}
        return SyntheticSubjects(
            [*train, *phantom_subjects(n_phantoms, h.seed, "training")],
            template,
            length=h.subjects_per_epoch,
            seed=h.seed,
            patch_size=h.patch_size,
            n_patches=h.patches_per_subject,
            distinct=h.distinct_epochs,
            **common,
        ), SyntheticSubjects(
            validated,
            template,
            length=h.val_subjects,
            seed=h.seed + VALIDATION_SEED,
            patch_size=h.val_crop,
            in_order=True,
            **common,
        )

    def train_dataloader(self) -> PatchBatches:
        """Batches of shuffled patches of this epoch's subjects."""
        h: Any = self.hparams
        n_batches = h.patches_per_subject * h.subjects_per_epoch // h.batch_size
        # the next subjects to be mixed should be ready when they are needed
        prefetch = MIXED_SUBJECTS if h.num_workers else None
        subjects = self.train_loader(
            h.subjects_per_epoch, n_batches, split_ranks=True, batch_size=None, prefetch_factor=prefetch
        )
        return PatchBatches(subjects, h.seed, h.patches_per_subject, h.batch_size)

    def val_dataloader(self) -> DataLoader:
        """A loader of the validation volumes, made once and the same in every epoch."""
        return self.val_loader()


class PatchBatches(IterableDataset[Patches]):
    """Batches of patches, shuffled among a few subjects at a time.

    No patches are carried over from one epoch to the next, and the order depends on seed and epoch only. An epoch is
    therefore the same whether or not the earlier epochs ran in this process.

    Args:
        subjects: loader that yields all patches of one subject at a time, with an `EpochSampler`.
        seed: of the order.
        n_patches: per subject.
        batch_size: patches per batch; the remainder of an epoch is dropped.
    """

    def __init__(self, subjects: DataLoader, seed: int, n_patches: int, batch_size: int) -> None:
        assert isinstance(subjects.sampler, EpochSampler)
        self.subjects = subjects
        self.sampler = subjects.sampler
        self.seed = seed
        self.n_patches = n_patches
        self.batch_size = batch_size

    def __len__(self) -> int:
        return self.n_patches * len(self.sampler) // self.batch_size

    def __iter__(self) -> Iterator[Patches]:
        waiting: list[Patches] = []
        arriving = iter(self.subjects)
        for first in range(0, len(self.sampler), MIXED_SUBJECTS):
            patches = [one for subject in islice(arriving, MIXED_SUBJECTS) for one in _single(subject)]
            rng = np.random.default_rng([self.seed, self.sampler.epoch, first, 2])
            waiting += [patches[k] for k in rng.permutation(len(patches))]
            while len(waiting) >= self.batch_size:
                batch, waiting = waiting[: self.batch_size], waiting[self.batch_size :]
                yield {key: torch.cat([one[key] for one in batch]) for key in batch[0]}


def _single(patches: dict[str, Tensor]) -> list[Patches]:
    """Patches of a subject as batches of one, without a copy."""
    n = len(patches["n_stacks"])
    return [{key: value[k : k + 1] for key, value in patches.items()} for k in range(n)]
