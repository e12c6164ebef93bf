"""LightningDataModule of the pose network: slice sets synthesised on the fly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader

from data_synth.atlas import TruthVolume
from data_synth.data_module import VALIDATION_SEED, SyntheticDataModule
from data_synth.head_variation import varied_head
from data_synth.heads import Subject, load_head
from data_synth.pose_samples import SliceSet, draw_slice_set
from data_synth.slice_sampling import Head
from data_synth.subject_dataset import SubjectDataset
from data_synth.template import atlas_templates
from data_synth.trajectories import RecordedTrajectory, load_trajectories
from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.acquisition.slice_images import batch_arrays
from g3r.geometry import RigidPose

HEAD_SPACING_MM = 2.0
"""Voxel size of the truth volume, smaller than the pixels of the slices."""
VAL_MAX_SLICES = 120
MAX_VALIDATION_STACKS = 6
N_VAL_PHANTOMS = 8
N_VARIANTS = 8
"""Variants (shape and contrast) per subject and epoch; making one takes as long as making several slice sets."""
MIN_SHARE = 4
"""The limit on slices is drawn for each training set from max_slices / MIN_SHARE to max_slices."""


class SliceSetDataModule(SyntheticDataModule):
    """Sets of slice images with true poses from an atlas folder or the built-in phantom.

    See `slice_set_batch` for a batch.

    Args:
        trajectories: npz file of recorded motion; None takes a model with the same statistics.
        pixel_mm: edge of the pixels.
        image_size: pixels per edge of a slice image.
        max_slices: upper limit of slices in a training set; each set draws its own limit, at least a quarter of this.
        batch_size: heads per training batch.
        sets_per_epoch: training sets per epoch.
        val_sets: validation sets; they have 1 to 6 stacks in turn.
        common: see `SyntheticDataModule`.

    Raises:
        InputError: a setting out of range, no such folder, or nothing in it passes the patterns.
    """

    def __init__(
        self,
        trajectories: str | None = None,
        pixel_mm: float = 3.0,
        image_size: int = 40,
        max_slices: int = 40,
        batch_size: int = 8,
        sets_per_epoch: int = 1600,
        val_sets: int = 36,
        **common: Any,
    ) -> None:
        super().__init__(**common)
        self.check_at_least_one("max_slices", "batch_size", "sets_per_epoch", "val_sets")
        self._template: AtlasTemplate | None = None

    def make_sets(self) -> tuple[SliceSets, SliceSets]:
        """Training sets, which differ from epoch to epoch, and validation sets, which do not."""
        h: Any = self.hparams
        train, val = self.subjects(N_VAL_PHANTOMS)
        recorded = load_trajectories(h.trajectories) if h.trajectories else []
        common = {"pixel_mm": h.pixel_mm, "size": h.image_size, "recorded": recorded}
        return SliceSets(train, length=h.sets_per_epoch, seed=h.seed, max_slices=h.max_slices, **common), SliceSets(
            val, length=h.val_sets, seed=h.seed + VALIDATION_SEED, max_slices=VAL_MAX_SLICES, in_order=True, **common
        )

    def template(self) -> AtlasTemplate:
        """Atlas template of the training subjects."""
        if self._template is None:
            self._template = atlas_templates(self.subjects(N_VAL_PHANTOMS)[0])
        return self._template

    def train_dataloader(self) -> DataLoader:
        """A loader of this epoch's sets."""
        h: Any = self.hparams
        n_batches = h.sets_per_epoch // h.batch_size
        return self.train_loader(
            h.sets_per_epoch, n_batches, batch_size=h.batch_size, collate_fn=slice_set_batch, drop_last=True
        )

    def val_dataloader(self) -> DataLoader:
        """A loader of the validation sets, one head per batch, the same in every epoch."""
        return self.val_loader(slice_set_batch)


class SliceSets(SubjectDataset[SliceSet]):
    """Slice sets made on the fly.

    Args:
        subjects: atlas subjects or phantoms.
        length: sets per epoch.
        seed: of the whole dataset.
        max_slices: see `draw_slice_set`.
        pixel_mm: see `draw_slice_set`.
        size: see `draw_slice_set`.
        recorded: see `draw_slice_set`.
        in_order: for validation: subjects and numbers of stacks in turn, heads without variation.
    """

    def __init__(
        self,
        subjects: Sequence[Subject],
        *,
        length: int,
        seed: int,
        max_slices: int,
        pixel_mm: float,
        size: int,
        recorded: Sequence[RecordedTrajectory] = (),
        in_order: bool = False,
    ) -> None:
        super().__init__(subjects, length, seed, in_order)
        self.max_slices, self.pixel_mm, self.size = max_slices, pixel_mm, size
        self.recorded = recorded
        self._heads: dict[tuple[int, int, int], Head] = {}

    def make(self, epoch: int, index: int) -> SliceSet:
        """Set (epoch, index)."""
        which, rng = self.draw(epoch, index)
        max_slices = self.max_slices
        if not self.in_order:  # many heads with few slices train faster than few heads with many slices
            max_slices = int(rng.integers(max(self.max_slices // MIN_SHARE, 1), self.max_slices + 1))
        return draw_slice_set(
            self._head(which, epoch, -1 if self.in_order else int(rng.integers(N_VARIANTS))),
            rng,
            self.pixel_mm,
            self.size,
            max_slices,
            n_stacks=1 + self.turn(index, MAX_VALIDATION_STACKS) if self.in_order else None,
            recorded=self.recorded,
        )

    def load(self, subject: Subject) -> TruthVolume:
        """The subject in the atlas frame."""
        return load_head(subject, HEAD_SPACING_MM)

    def _head(self, which: int, epoch: int, variant: int) -> Head:
        """A subject's head, unchanged (variant -1) or one of its variants of this epoch."""
        key = (which, epoch if variant >= 0 else 0, variant)
        if key not in self._heads:
            volume = self.volume(which)
            if variant >= 0:
                self._heads = {k: head for k, head in self._heads.items() if k[1] == epoch}
                volume = varied_head(volume, np.random.default_rng([self.seed, epoch, which, variant, 1]))
            self._heads[key] = Head.from_volume(volume)
        return self._heads[key]


def slice_set_batch(sets: Sequence[SliceSet]) -> dict[str, torch.Tensor]:
    """A `SliceBatch` of several heads, with `true_rotation` [S, 3, 3] and `true_translation_mm` [S, 3]."""
    batch = batch_arrays([one.images for one in sets])
    true = RigidPose.concatenated([one.true_pose for one in sets])
    batch["true_rotation"] = true.rotation.astype(np.float32)
    batch["true_translation_mm"] = true.translation_mm.astype(np.float32)
    return {name: torch.from_numpy(value) for name, value in batch.items()}
