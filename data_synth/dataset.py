"""Synthetic training subjects: a truth volume, sliced, mis-registered, scattered back to V_coarse and M_rho.

A subject is a function of (seed, epoch, index) and the settings alone, whatever process or order makes it.
"""

from __future__ import annotations

import logging
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torchio as tio
from numpy.typing import NDArray
from torch.utils.data import Dataset

from data_synth.atlas import TruthVolume, cropped
from data_synth.augment import augmentation, augmented
from data_synth.heads import Subject, load_volume_of
from data_synth.motion import ResidualKind, draw_residual_kind, residual_errors
from data_synth.protocol_sampling import (
    SKULL_RIM_SHARE,
    SMALL_MASK_SHARE,
    draw_settings,
    rigid_stack,
    with_mask_errors,
    with_skull_rim,
)
from data_synth.simulator import SimulatedStack, StackSettings, simulate_stacks
from data_synth.subject_cache import KeptSubjects, SyntheticSubject
from g3r.acquisition.coarse_volume import coarse_and_density, normalisation_scale
from g3r.acquisition.least_squares import sharpened_volume
from g3r.acquisition.planes import Slices, slices_from_stacks
from g3r.geometry import RigidPose, VolumeGrid

logger = logging.getLogger(__name__)

IMAGE_KEYS = ("coarse", "density", "sharp", "truth", "mask")
SAMPLE_SEED_KEY, N_STACKS_KEY = "sample_seed", "n_stacks"
VALIDATION_STACKS = 3
MARGIN_VOXELS = 6
"""Background kept around a head: the network must learn that nothing is there."""

IN_LINE_SHARE = 0.6
"""How often nothing is known of how the slices of a single stack moved against each other."""
NOTICED_SHARE = 0.7
"""How often a slice without signal has been given a low weight."""


class SyntheticSubjects(Dataset):
    """Subjects synthesised on the fly; item n is (epoch, index) = divmod(n, length).

    Args:
        sources: atlas subjects or phantoms; loaded on first use and kept in memory.
        spacing_mm: voxel size.
        length: subjects per epoch.
        seed: of the whole dataset.
        min_shape: grids are padded to at least this many voxels per axis.
        augment: whether truth volumes are varied by torchio.
        in_order: take the sources in turn instead of drawing them, and 1, 2, 3 stacks in turn (validation).
        distinct: after so many epochs the same subjects come again, cut into other patches; 0 for never.
        cache: folder that keeps subjects once made; None keeps none.
    """

    def __init__(
        self,
        sources: Sequence[Subject],
        spacing_mm: float = 0.8,
        length: int = 32,
        seed: int = 0,
        min_shape: int = 64,
        augment: bool = True,
        in_order: bool = False,
        distinct: int = 0,
        cache: str | Path | None = None,
    ) -> None:
        if not sources:
            raise ValueError("a dataset needs at least one source")
        self.sources = list(sources)
        self.spacing_mm = spacing_mm
        self.length = length
        self.seed = seed
        self.min_shape = min_shape
        self.augment = augmentation() if augment else None
        self.in_order = in_order
        self.distinct = distinct
        self.kept = KeptSubjects(cache, self._recipe()) if cache is not None else None
        self._volumes: dict[int, TruthVolume] = {}

    def _recipe(self) -> str:
        """All that decides the subjects, besides the code."""
        names = [source.name for source in self.sources]
        return repr((names, self.spacing_mm, self.seed, self.min_shape, self.augment is not None, self.in_order))

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, number: int) -> tio.Subject:
        """Item `number` as a torchio subject with images `coarse`, `density`, `truth` and `mask`."""
        epoch, index = divmod(int(number), self.length)
        one = self.sample(epoch, index)

        def image(array: NDArray[np.generic]) -> tio.ScalarImage:
            return tio.ScalarImage(tensor=torch.from_numpy(array.astype(np.float32))[None], affine=one.affine)

        images = {key: image(getattr(one, key)) for key in IMAGE_KEYS}
        extra = {SAMPLE_SEED_KEY: (self.seed, epoch, index), N_STACKS_KEY: one.n_stacks}
        return tio.Subject(**images, name=one.name, **extra)

    def sample(self, epoch: int, index: int) -> SyntheticSubject:
        """Subject (epoch, index)."""
        if self.distinct:
            epoch %= self.distinct
        if self.kept is None:
            return self._made(epoch, index)
        found = self.kept.load(epoch, index)
        if found is None:
            found = self._made(epoch, index)
            self.kept.save(epoch, index, found)
        return found

    def _made(self, epoch: int, index: int) -> SyntheticSubject:
        rng = np.random.default_rng([self.seed, epoch, index])
        which = index % len(self.sources) if self.in_order else int(rng.integers(len(self.sources)))
        truth = self._volume(which)
        if self.augment is not None:
            truth = augmented(truth, self.augment, rng)
        truth = _padded(cropped(truth, MARGIN_VOXELS), self.min_shape)
        return synthesise(truth, rng, 1 + index % VALIDATION_STACKS if self.in_order else None)

    def _volume(self, which: int) -> TruthVolume:
        if which not in self._volumes:
            volume = load_volume_of(self.sources[which], self.spacing_mm)
            self._volumes[which] = cropped(volume, MARGIN_VOXELS + 4)
        return self._volumes[which]


def synthesise(truth: TruthVolume, rng: np.random.Generator, n_stacks: int | None = None) -> SyntheticSubject:
    """One training subject from a truth volume: stacks with random settings, pose errors, Eq. 6.

    Args:
        truth: the head.
        rng: source of randomness.
        n_stacks: drawn when None.

    Raises:
        InputError: no head moved into view in any draw (volumes with an all but empty mask).
    """
    residual = draw_residual_kind(rng)
    settings = draw_settings(residual, rng, n_stacks)
    kind = rng.random()
    seen = with_skull_rim(truth, rng) if kind < SKULL_RIM_SHARE else truth
    stacks = simulate_stacks(seen.data, seen.mask, seen.affine, settings, rng)
    if kind < SKULL_RIM_SHARE + SMALL_MASK_SHARE:
        stacks = with_mask_errors(stacks, rng, grow=kind < SKULL_RIM_SHARE)
    slices = slices_from_stacks([one.stack for one in stacks])
    grid = VolumeGrid(truth.data.shape, truth.affine)
    found = _poses_left_by_registration(stacks, settings, slices, grid.center_mm, residual, rng)
    weight = _trust(stacks, slices, rng)
    slices = slices.with_pose(found)
    coarse, density = coarse_and_density(slices, grid, weight=weight)
    sharp = sharpened_volume(slices, grid, coarse, weight=weight)
    scale = np.float32(normalisation_scale(coarse, density))
    inside = np.where(truth.mask, truth.data, 0) / scale
    return SyntheticSubject(
        coarse / scale,
        density,
        sharp / scale,
        inside.astype(np.float32),
        truth.mask,
        truth.affine,
        truth.name,
        len(stacks),
        residual,
    )


def _poses_left_by_registration(
    stacks: Sequence[SimulatedStack],
    settings: Sequence[StackSettings],
    slices: Slices,
    center_mm: NDArray[np.float64],
    residual: ResidualKind,
    rng: np.random.Generator,
) -> RigidPose:
    """Poses that the prior is given: true ones with errors, or for single stacks often one motion for all."""
    true_pose = _per_slice(stacks, slices.stack_id, slices.slice_index)
    motion = true_pose
    no_jerks = settings[0].motion.n_jerks == 0  # registration finds those
    if len(stacks) == 1 and no_jerks and residual != "gross" and rng.random() < IN_LINE_SHARE:
        motion = rigid_stack(true_pose, center_mm)
    exact = motion @ slices.planes.pose
    return residual_errors(residual, slices.stack_id, exact.translation_mm, rng) @ exact


def _trust(stacks: Sequence[SimulatedStack], slices: Slices, rng: np.random.Generator) -> NDArray[np.float64]:
    """Weight of each masked pixel: registration mostly notices slices without signal."""
    dropout = np.array([stacks[s].dropout[k] for s, k in zip(slices.stack_id, slices.slice_index, strict=True)])
    noticed = dropout & (rng.random(len(dropout)) < NOTICED_SHARE)
    return np.where(noticed, rng.uniform(0, 0.3, len(dropout)), 1.0)[slices.pixel_plane]


class HeadPatchSampler(tio.data.PatchSampler):
    """Patches centred on random voxels of the mask and moved back onto the grid; fixed by the subject."""

    def _generate_patches(self, subject: Any, num_patches: int | None = None) -> Generator[tio.Subject, None, None]:
        rng = np.random.default_rng([*subject[SAMPLE_SEED_KEY], 1])
        inside = np.flatnonzero(subject["mask"].data[0].numpy() > 0.5)
        size, shape = self.patch_size.astype(int), np.array(subject.spatial_shape)
        n_made = 0
        while num_patches is None or n_made < num_patches:
            center = np.array(np.unravel_index(int(rng.choice(inside)), tuple(shape)))
            first = np.clip(center - size // 2, 0, shape - size)
            yield self.extract_patch(subject, (int(first[0]), int(first[1]), int(first[2])))
            n_made += 1


def central_crop(subject: tio.Subject, size: int) -> tio.Subject:
    """The cube of `size` voxels in the middle of a subject."""
    i, j, k = ((n - size) // 2 for n in subject.spatial_shape)
    return tio.data.PatchSampler(size).extract_patch(subject, (i, j, k))


def _per_slice(
    stacks: Sequence[SimulatedStack], stack_id: NDArray[np.int64], slice_index: NDArray[np.int64]
) -> RigidPose:
    pairs = list(zip(stack_id, slice_index, strict=True))
    return RigidPose(
        np.stack([stacks[s].true_pose.rotation[k] for s, k in pairs]),
        np.stack([stacks[s].true_pose.translation_mm[k] for s, k in pairs]),
    )


def _padded(volume: TruthVolume, smallest: int) -> TruthVolume:
    """The volume with zeros on both sides of each axis shorter than `smallest` voxels."""
    missing = np.maximum(smallest - np.array(volume.data.shape), 0)
    if not missing.any():
        return volume
    width = [(int(n) // 2, int(n) - int(n) // 2) for n in missing]
    affine = volume.affine.copy()
    affine[:3, 3] -= affine[:3, :3] @ [before for before, _ in width]
    return TruthVolume(volume.name, np.pad(volume.data, width), np.pad(volume.mask, width), affine)
