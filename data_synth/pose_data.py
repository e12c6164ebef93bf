"""The LightningDataModule that trains the pose network on slice sets synthesised on the fly."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader, Dataset

from data_synth.atlas import TruthVolume
from data_synth.head_variation import varied_head
from data_synth.heads import Subject, load_head, training_and_validation
from data_synth.pose_samples import SliceSet, draw_slice_set
from data_synth.prior_data import EpochSampler, epoch_of
from data_synth.slice_sampling import Head
from data_synth.template import atlas_templates
from data_synth.trajectories import RecordedTrajectory, load_trajectories
from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.errors import InputError

logger = logging.getLogger(__name__)

HEAD_SPACING_MM = 2.0
"""Voxel size of the truth that is sliced; pixels are larger."""
VAL_MAX_SLICES = 120
N_VAL_PHANTOMS = 8
N_VARIANTS = 8
"""Shapes and contrasts per subject and epoch; making one takes as long as several slice sets."""
MIN_SHARE = 4
"""A training set has at least this fraction (one over it) of the largest number of slices."""


class SliceSetDataModule(LightningDataModule):
    """Sets of slice images with true poses from an atlas folder or the built-in phantom.

    Training sets differ from epoch to epoch, validation sets never. See `slice_set_batch` for a batch.

    Args:
        source: `phantom`, or a folder of NIfTI volumes with masks (see `data_synth.atlas`).
        include: glob patterns of subject names for training; none takes all.
        exclude: glob patterns of subject names not to train on.
        val_include: glob patterns of subject names to validate on; they are not trained on. None validates on
            other sets of the training subjects, which flatters the network, and says so.
        trajectories: npz file of recorded motion; None takes a model with the statistics of one.
        template_spacing_mm: voxel size of the template of mean heads.
        pixel_mm: edge of the pixels.
        image_size: pixels per edge of a slice image.
        max_slices: of a training set; for each set a number from a quarter of it on is drawn.
        batch_size: heads per training batch.
        sets_per_epoch: training sets per epoch.
        val_sets: validation sets; their numbers of stacks go through 1 to 6 in turn.
        num_workers: processes that synthesise beside the training.
        seed: decides every set together with its epoch and index.

    Raises:
        InputError: no such folder, or nothing in it passes the patterns.
    """

    def __init__(
        self,
        source: str = "phantom",
        include: list[str] | None = None,
        exclude: list[str] | None = None,
        val_include: list[str] | None = None,
        trajectories: str | None = None,
        template_spacing_mm: float = 3.0,
        pixel_mm: float = 3.0,
        image_size: int = 40,
        max_slices: int = 40,
        batch_size: int = 8,
        sets_per_epoch: int = 1600,
        val_sets: int = 36,
        num_workers: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        for name, value in (
            ("max_slices", max_slices),
            ("batch_size", batch_size),
            ("sets_per_epoch", sets_per_epoch),
            ("val_sets", val_sets),
        ):
            if value < 1:
                raise InputError(f"data.{name}: {value}; expected at least 1")
        self._subjects: tuple[list[Subject], list[Subject]] | None = None
        self._template: AtlasTemplate | None = None
        self.train_sets: SliceSets | None = None
        self.val_sets: SliceSets | None = None

    def setup(self, stage: str | None = None) -> None:
        """Find the subjects; volumes are loaded before they are needed."""
        if self.train_sets is not None:
            return
        h: Any = self.hparams
        train, val = self._sources()
        recorded = load_trajectories(h.trajectories) if h.trajectories else []
        logger.info("slice sets from %d training and %d validation subjects", len(train), len(val))
        common = {"pixel_mm": h.pixel_mm, "size": h.image_size, "recorded": recorded}
        self.train_sets = SliceSets(train, h.sets_per_epoch, h.seed, max_slices=h.max_slices, **common)
        self.val_sets = SliceSets(
            val, h.val_sets, h.seed + 1_000_003, max_slices=VAL_MAX_SLICES, in_order=True, **common
        )

    def template(self) -> AtlasTemplate:
        """Mean heads of the training subjects."""
        if self._template is None:
            h: Any = self.hparams
            self._template = atlas_templates(self._sources()[0], h.template_spacing_mm)
        return self._template

    def train_dataloader(self) -> DataLoader:
        """This epoch's sets."""
        self.setup()
        h: Any = self.hparams
        assert self.train_sets is not None
        now = epoch_of(self.trainer, max(1, h.sets_per_epoch // h.batch_size))
        return DataLoader(
            self.train_sets,
            batch_size=h.batch_size,
            sampler=EpochSampler(h.sets_per_epoch, now=now),
            num_workers=h.num_workers,
            multiprocessing_context="spawn" if h.num_workers else None,
            persistent_workers=h.num_workers > 0,
            collate_fn=slice_set_batch,
            drop_last=True,
        )

    def val_dataloader(self) -> DataLoader:
        """The same sets each time, one head at a time."""
        self.setup()
        assert self.val_sets is not None
        return DataLoader(self.val_sets, batch_size=1, collate_fn=slice_set_batch)

    def _sources(self) -> tuple[list[Subject], list[Subject]]:
        h: Any = self.hparams
        if self._subjects is None:
            self._subjects = training_and_validation(
                h.source, h.include, h.exclude, h.val_include, None, N_VAL_PHANTOMS, h.seed
            )
        return self._subjects


class SliceSets(Dataset):
    """Slice sets made on the fly; item n is (epoch, index) = divmod(n, length).

    Args:
        sources: atlas subjects or phantoms; loaded on first use and kept in memory.
        length: sets per epoch.
        seed: of the whole dataset.
        max_slices: see `draw_slice_set`.
        pixel_mm: see `draw_slice_set`.
        size: see `draw_slice_set`.
        recorded: see `draw_slice_set`.
        in_order: take sources and numbers of stacks in turn, and keep what was made (validation).
    """

    def __init__(
        self,
        sources: Sequence[Subject],
        length: int,
        seed: int,
        max_slices: int,
        pixel_mm: float,
        size: int,
        recorded: Sequence[RecordedTrajectory] = (),
        in_order: bool = False,
    ) -> None:
        if not sources:
            raise ValueError("a dataset needs at least one source")
        self.sources, self.length, self.seed = list(sources), length, seed
        self.max_slices, self.pixel_mm, self.size = max_slices, pixel_mm, size
        self.recorded, self.in_order = recorded, in_order
        self._volumes: dict[int, TruthVolume] = {}
        self._heads: dict[tuple[int, int, int], Head] = {}
        self._made: dict[int, SliceSet] = {}

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, number: int) -> SliceSet:
        """Item `number`."""
        if number in self._made:
            return self._made[number]
        epoch, index = divmod(int(number), self.length)
        rng = np.random.default_rng([self.seed, epoch, index])
        which = index % len(self.sources) if self.in_order else int(rng.integers(len(self.sources)))
        max_slices = self.max_slices
        if not self.in_order:  # many heads of few slices teach more per second than few heads of many
            max_slices = int(rng.integers(max(self.max_slices // MIN_SHARE, 1), self.max_slices + 1))
        made = draw_slice_set(
            self._head(which, epoch, -1 if self.in_order else int(rng.integers(N_VARIANTS))),
            rng,
            self.pixel_mm,
            self.size,
            max_slices,
            n_stacks=1 + index % 6 if self.in_order else None,
            recorded=self.recorded,
        )
        if self.in_order:
            self._made[number] = made
        return made

    def _head(self, which: int, epoch: int, variant: int) -> Head:
        """A subject as it is (variant -1) or one of its variants of this epoch."""
        key = (which, epoch if variant >= 0 else 0, variant)
        if key not in self._heads:
            if which not in self._volumes:
                self._volumes[which] = load_head(self.sources[which], HEAD_SPACING_MM)
            volume = self._volumes[which]
            if variant >= 0:
                self._heads = {k: head for k, head in self._heads.items() if k[1] == epoch}
                volume = varied_head(volume, np.random.default_rng([self.seed, epoch, which, variant, 1]))
            self._heads[key] = Head.from_volume(volume)
        return self._heads[key]


def slice_set_batch(sets: Sequence[SliceSet]) -> dict[str, torch.Tensor]:
    """The slices of several heads as one dict of tensors, with their true poses.

    Keys: `image` [S, 1, N, N], `area_mm2`, `position_mm`, `thickness_mm`, `time_rank` [S], `stack` [S]
    numbered through all heads, `set_of_stack` [G], `header_rotation` and `true_rotation` [S, 3, 3],
    `true_translation_mm` [S, 3].
    """
    batch: dict[str, np.ndarray] = {
        name: np.concatenate([getattr(one.images, name) for one in sets]).astype(np.float32)
        for name in ("image", "area_mm2", "position_mm", "thickness_mm", "time_rank", "header_rotation")
    }
    batch["image"] = batch["image"][:, None]
    batch["true_rotation"] = np.concatenate([s.true_pose.rotation for s in sets]).astype(np.float32)
    batch["true_translation_mm"] = np.concatenate([s.true_pose.translation_mm for s in sets]).astype(np.float32)
    n_stacks = [int(one.images.stack_id.max()) + 1 for one in sets]
    first = np.cumsum([0, *n_stacks])
    batch["stack"] = np.concatenate([one.images.stack_id + first[k] for k, one in enumerate(sets)])
    batch["set_of_stack"] = np.repeat(np.arange(len(sets)), n_stacks)
    return {name: torch.from_numpy(value) for name, value in batch.items()}
