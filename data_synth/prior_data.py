"""The LightningDataModule that trains the prior network on stacks synthesised on the fly."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
import torch
import torchio as tio
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader, Dataset, Sampler

from data_synth.dataset import (
    IMAGE_KEYS,
    N_STACKS_KEY,
    SAMPLE_SEED_KEY,
    HeadPatchSampler,
    SyntheticSubjects,
    central_crop,
)
from data_synth.heads import Subject, phantom_subjects, training_and_validation
from g3r.errors import InputError

logger = logging.getLogger(__name__)

QUEUE_SUBJECTS = 4
"""Subjects whose patches are mixed in the queue."""


class StackSynthesisDataModule(LightningDataModule):
    """Patches of (V_coarse, M_rho, truth, mask) from an atlas folder or the built-in phantom.

    A batch is a dict of float32 tensors [B, 1, I, J, K] with the keys `coarse`, `density`, `sharp`, `truth`
    and `mask`, and `n_stacks`, int64 [B].
    Training patches differ from epoch to epoch, validation volumes never.

    Args:
        source: `phantom`, or a folder of NIfTI volumes with masks (see `data_synth.atlas`).
        include: glob patterns of subject names for training; none takes all.
        exclude: glob patterns of subject names not to train on.
        val_include: glob patterns of subject names to validate on; they are not trained on. None validates on
            other simulations of the training subjects, which flatters the network, and says so.
        val_exclude: glob patterns of subject names not to validate on.
        phantom_share: share (0 to 1) of phantoms among the training subjects of an atlas folder.
        spacing_mm: isotropic voxel size.
        patch_size: edge of a training patch in voxels.
        patches_per_subject: patches cut from each synthetic subject.
        batch_size: patches per training batch.
        subjects_per_epoch: synthetic subjects per epoch.
        val_subjects: validation volumes.
        val_crop: edge in voxels of the central cube that is validated on.
        num_workers: processes that synthesise beside the training.
        distinct_epochs: after so many epochs the same subjects come again, in other patches; 0 for never.
        cache: folder that keeps synthetic subjects once made (about 15 MB each); None keeps none.
        seed: decides every sample together with its epoch and index.

    Raises:
        InputError: no such folder, or nothing in it passes the patterns.
    """

    def __init__(
        self,
        source: str = "phantom",
        include: list[str] | None = None,
        exclude: list[str] | None = None,
        val_include: list[str] | None = None,
        val_exclude: list[str] | None = None,
        phantom_share: float = 0.0,
        spacing_mm: float = 0.8,
        patch_size: int = 64,
        patches_per_subject: int = 8,
        batch_size: int = 4,
        subjects_per_epoch: int = 32,
        val_subjects: int = 4,
        val_crop: int = 96,
        num_workers: int = 0,
        distinct_epochs: int = 0,
        cache: str | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        for name, value in (
            ("patch_size", patch_size),
            ("patches_per_subject", patches_per_subject),
            ("batch_size", batch_size),
            ("subjects_per_epoch", subjects_per_epoch),
            ("val_subjects", val_subjects),
            ("val_crop", val_crop),
        ):
            if value < 1:
                raise InputError(f"data.{name}: {value}; expected at least 1")
        if not 0 <= phantom_share < 1:
            raise InputError(f"data.phantom_share: {phantom_share:g}; expected 0 to below 1")
        if batch_size > patches_per_subject * subjects_per_epoch:
            raise InputError(
                f"data.batch_size: {batch_size}, but an epoch has {patches_per_subject * subjects_per_epoch} "
                "patches; raise subjects_per_epoch"
            )
        self.spacing_mm = spacing_mm
        self.train_subjects: SyntheticSubjects | None = None
        self.val_volumes: FixedCrops | None = None

    def setup(self, stage: str | None = None) -> None:
        """Find the subjects; nothing is loaded before it is needed."""
        if self.train_subjects is not None:
            return
        h: Any = self.hparams
        train, val = self._sources()
        logger.info("synthesis from %d training and %d validation subjects", len(train), len(val))
        self.train_subjects = SyntheticSubjects(
            train,
            h.spacing_mm,
            h.subjects_per_epoch,
            h.seed,
            min_shape=h.patch_size,
            distinct=h.distinct_epochs,
            cache=h.cache,
        )
        fixed = SyntheticSubjects(
            val,
            h.spacing_mm,
            h.val_subjects,
            h.seed + 1_000_003,
            h.val_crop,
            augment=False,
            in_order=True,
            cache=h.cache,
        )
        self.val_volumes = FixedCrops(fixed, h.val_crop)

    def train_dataloader(self) -> DataLoader:
        """Shuffled patches of this epoch's subjects, a queue ahead."""
        self.setup()
        h: Any = self.hparams
        assert self.train_subjects is not None
        rank, n_ranks = 0, 1
        if self.trainer is not None:
            rank, n_ranks = self.trainer.global_rank, self.trainer.world_size
        n_batches = h.patches_per_subject * h.subjects_per_epoch // h.batch_size
        queue = PatchQueue(
            self.train_subjects,  # type: ignore[arg-type]  # any dataset of subjects will do
            max_length=h.patches_per_subject * min(QUEUE_SUBJECTS, h.subjects_per_epoch),
            samples_per_volume=h.patches_per_subject,
            sampler=HeadPatchSampler(h.patch_size),
            subject_sampler=EpochSampler(h.subjects_per_epoch, 0, rank, n_ranks, epoch_of(self.trainer, n_batches)),
            shuffle_subjects=False,
            num_workers=h.num_workers,
            start_background=False,  # a run that goes on does not know its epoch yet
        )
        return tio.SubjectsLoader(
            queue, batch_size=h.batch_size, num_workers=0, drop_last=True, collate_fn=collate_images
        )

    def val_dataloader(self) -> DataLoader:
        """The same few volumes each time, made once."""
        self.setup()
        assert self.val_volumes is not None
        return tio.SubjectsLoader(self.val_volumes, batch_size=1, num_workers=0, collate_fn=collate_images)

    def _sources(self) -> tuple[list[Subject], list[Subject]]:
        h: Any = self.hparams
        train, val = training_and_validation(
            h.source, h.include, h.exclude, h.val_include, h.val_exclude, h.val_subjects, h.seed
        )
        if h.source == "phantom":
            return train, val
        # spread over the names, which mostly sort by age
        step = max(1, len(val) // h.val_subjects)
        val = val[step // 2 :: step][: h.val_subjects]
        n_phantoms = round(len(train) * h.phantom_share / (1 - h.phantom_share))
        if n_phantoms:
            train += phantom_subjects(n_phantoms, h.seed, "training")
        return train, val


def epoch_of(trainer: Any, n_batches: int) -> Callable[[], int] | None:
    """Tells the epoch of a trainer, of which loaders are made before a checkpoint has said how far it is.

    Args:
        trainer: None where there is none; then nothing is known.
        n_batches: of an epoch.
    """
    if trainer is None:
        return None
    # an epoch that ended with the checkpoint is counted by its steps first
    return lambda: max(trainer.current_epoch, trainer.global_step // n_batches)


class EpochSampler(Sampler[int]):
    """Numbers epoch * length + index, one epoch further each time it is iterated.

    Args:
        length: of an epoch, over all processes; this is what `len` says, too.
        epoch: to begin with.
        now: says which epoch it is when it is iterated; None counts.
        rank: of this process. Each of `n_ranks` processes has numbers of its own.
        n_ranks: processes that train together.
    """

    def __init__(
        self, length: int, epoch: int = 0, rank: int = 0, n_ranks: int = 1, now: Callable[[], int] | None = None
    ) -> None:
        self.now = now
        self.length = length
        self.epoch = epoch
        self.rank = rank
        self.n_ranks = n_ranks

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[int]:
        if self.now is not None:
            self.epoch = self.now()
        first = self.epoch * self.length
        self.epoch += 1
        return iter(range(first + self.rank % self.length, first + self.length, self.n_ranks))


class PatchQueue(tio.Queue):
    """torchio's queue for subjects that are made, not listed; it knows its length without the sampler.

    An epoch begins with an empty queue and is shuffled by what is in it, so that it is the same whether or
    not the epochs before it ran in this process.
    """

    _subjects_loader: DataLoader | None = None

    def __getitem__(self, index: int) -> tio.Subject:
        """The next patch; number 0 begins an epoch."""
        if index == 0:
            self.patches_list.clear()  # left over where batches do not go into an epoch
            if self._subjects_iterable is None or self._num_sampled_subjects:
                self._initialize_subjects_iterable()
        return super().__getitem__(index)

    def _shuffle_patches_list(self) -> None:
        patches: Any = self.patches_list
        own = [number for patch in patches for number in patch[SAMPLE_SEED_KEY]]
        order = np.random.default_rng([*own, 2]).permutation(len(self.patches_list))
        self.patches_list = [self.patches_list[k] for k in order]

    @property
    def iterations_per_epoch(self) -> int:
        """Number of patches per epoch."""
        return self.num_subjects * self.samples_per_volume

    def _get_subjects_iterable(self) -> Iterator[tio.Subject]:
        self._num_sampled_subjects = 0
        if self._subjects_loader is None:
            # Workers are spawned, because numba's and torch's thread pools do not survive a fork, and stay,
            # because they hold the loaded volumes.
            self._subjects_loader = DataLoader(
                self.subjects_dataset,
                num_workers=self.num_workers,
                # the queue takes several subjects at once; the next ones should be ready by then
                prefetch_factor=QUEUE_SUBJECTS if self.num_workers else None,
                batch_size=1,
                collate_fn=_first,
                sampler=self.subject_sampler,
                multiprocessing_context="spawn" if self.num_workers else None,
                persistent_workers=self.num_workers > 0,
                worker_init_fn=_one_thread,
            )
        return iter(self._subjects_loader)


class FixedCrops(Dataset):
    """Central cubes of a dataset's first epoch, synthesised once and kept."""

    def __init__(self, subjects: SyntheticSubjects, size: int) -> None:
        self.subjects = subjects
        self.size = size
        self._made: dict[int, tio.Subject] = {}

    def __len__(self) -> int:
        return len(self.subjects)

    def __getitem__(self, index: int) -> tio.Subject:
        if index not in self._made:
            self._made[index] = central_crop(self.subjects[index], self.size)
        return self._made[index]


def collate_images(subjects: list[Any]) -> dict[str, torch.Tensor]:
    """A plain dict of float32 tensors [B, 1, I, J, K] and of numbers [B], without torchio's nesting."""
    batch = {key: torch.stack([subject[key].data for subject in subjects]).float() for key in IMAGE_KEYS}
    return {**batch, N_STACKS_KEY: torch.tensor([int(subject[N_STACKS_KEY]) for subject in subjects])}


def _first(batch: list[tio.Subject]) -> tio.Subject:
    return batch[0]


def _one_thread(worker: int) -> None:
    """Keep a worker process to one core; the training has the others."""
    import SimpleITK as sitk

    torch.set_num_threads(1)
    numba.set_num_threads(1)
    sitk.ProcessObject.SetGlobalDefaultNumberOfThreads(1)
