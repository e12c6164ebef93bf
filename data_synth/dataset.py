"""Synthetic training subjects: a truth volume, sliced, mis-registered, scattered back to V_coarse and M_rho.

A subject is a function of (seed, epoch, index) and the settings alone, whatever process or order makes it.
"""

from __future__ import annotations

import logging
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import torchio as tio
from numpy.typing import NDArray
from torch.utils.data import Dataset

from data_synth.atlas import TruthVolume, cropped
from data_synth.augment import augmentation, augmented
from data_synth.heads import Subject, load_volume_of
from data_synth.motion import LEVELS, ResidualKind, draw_residual_kind, residual_errors
from data_synth.simulator import Orientation, SimulatedStack, StackSettings, simulate_stacks
from g3r.acquisition.planes import slices_from_stacks
from g3r.acquisition.scatter import coarse_and_density, normalisation_scale
from g3r.geometry import RigidPose, VolumeGrid

logger = logging.getLogger(__name__)

IMAGE_KEYS = ("coarse", "density", "truth", "mask")
SAMPLE_SEED_KEY = "sample_seed"
MARGIN_VOXELS = 6
"""Background kept around a head: the network must learn that nothing is there."""

N_STACKS_SHARE = {1: 0.12, 2: 0.16, 3: 0.36, 4: 0.16, 5: 0.1, 6: 0.1}
VOID_SHARE_IF_GROSS = 0.03


@dataclass(frozen=True)
class SyntheticSubject:
    """What the network sees and should answer, [I, J, K] on the truth's grid, in normalised intensities."""

    coarse: NDArray[np.float32]
    density: NDArray[np.float32]
    truth: NDArray[np.float32]
    mask: NDArray[np.bool_]
    affine: NDArray[np.float64]
    name: str
    n_stacks: int
    residual: ResidualKind


class SyntheticSubjects(Dataset):
    """Subjects synthesised on the fly; item n is (epoch, index) = divmod(n, length).

    Args:
        sources: atlas subjects or phantoms; loaded on first use and kept in memory.
        spacing_mm: voxel size.
        length: subjects per epoch.
        seed: of the whole dataset.
        smallest_shape: grids are padded to at least this many voxels per axis.
        augment: whether truth volumes are varied by torchio.
        in_order: take the sources in turn instead of drawing them (validation).
    """

    def __init__(
        self,
        sources: Sequence[Subject],
        spacing_mm: float = 0.8,
        length: int = 32,
        seed: int = 0,
        smallest_shape: int = 64,
        augment: bool = True,
        in_order: bool = False,
    ) -> None:
        if not sources:
            raise ValueError("a dataset needs at least one source")
        self.sources = list(sources)
        self.spacing_mm = spacing_mm
        self.length = length
        self.seed = seed
        self.smallest_shape = smallest_shape
        self.augment = augmentation() if augment else None
        self.in_order = in_order
        self._cache: dict[int, TruthVolume] = {}

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, number: int) -> tio.Subject:
        """Item `number` as a torchio subject with images `coarse`, `density`, `truth` and `mask`."""
        epoch, index = divmod(int(number), self.length)
        one = self.sample(epoch, index)

        def image(array: NDArray[np.generic]) -> tio.ScalarImage:
            return tio.ScalarImage(tensor=torch.from_numpy(array.astype(np.float32))[None], affine=one.affine)

        images = {key: image(getattr(one, key)) for key in IMAGE_KEYS}
        return tio.Subject(**images, name=one.name, **{SAMPLE_SEED_KEY: (self.seed, epoch, index)})

    def sample(self, epoch: int, index: int) -> SyntheticSubject:
        """Subject (epoch, index)."""
        rng = np.random.default_rng([self.seed, epoch, index])
        which = index % len(self.sources) if self.in_order else int(rng.integers(len(self.sources)))
        truth = self._volume(which)
        if self.augment is not None:
            truth = augmented(truth, self.augment, rng)
        truth = _padded(cropped(truth, MARGIN_VOXELS), self.smallest_shape)
        return synthesise(truth, rng)

    def _volume(self, which: int) -> TruthVolume:
        if which not in self._cache:
            volume = load_volume_of(self.sources[which], self.spacing_mm)
            self._cache[which] = cropped(volume, MARGIN_VOXELS + 4)
        return self._cache[which]


def synthesise(truth: TruthVolume, rng: np.random.Generator) -> SyntheticSubject:
    """One training subject from a truth volume: stacks with random settings, pose errors, Eq. 6.

    Raises:
        InputError: no head moved into view in any draw (volumes with an all but empty mask).
    """
    residual = draw_residual_kind(rng)
    stacks = simulate_stacks(truth.data, truth.mask, truth.affine, draw_settings(residual, rng), rng)
    slices = slices_from_stacks([one.stack for one in stacks])
    true_pose = _per_slice(stacks, slices.stack_id, slices.slice_index)
    exact = true_pose @ slices.planes.pose
    error = residual_errors(residual, slices.stack_id, exact.translation_mm, rng)
    grid = VolumeGrid(truth.data.shape, truth.affine)
    coarse, density = coarse_and_density(slices.with_pose(error @ exact), grid)
    scale = np.float32(normalisation_scale(coarse, density))
    inside = np.where(truth.mask, truth.data, 0) / scale
    return SyntheticSubject(
        coarse / scale,
        density,
        inside.astype(np.float32),
        truth.mask,
        truth.affine,
        truth.name,
        len(stacks),
        residual,
    )


def draw_settings(residual: ResidualKind, rng: np.random.Generator) -> list[StackSettings]:
    """Settings of one to six stacks as a protocol may have them: one resolution, mostly orthogonal."""
    n_stacks = int(rng.choice(list(N_STACKS_SHARE), p=list(N_STACKS_SHARE.values())))
    level = LEVELS[str(rng.choice(["none", "mild", "moderate"]))]
    if residual == "gross":
        level = replace(level, dropout_share=VOID_SHARE_IF_GROSS)
    thickness = float(rng.uniform(2.0, 5.0) if rng.random() < 0.4 else rng.uniform(2.0, 3.5))
    orthogonal: list[Orientation] = ["axial", "coronal", "sagittal"]
    first = int(rng.integers(3))
    common = StackSettings(
        resolution_mm=float(rng.uniform(0.6, 1.3)),
        thickness_mm=thickness,
        gap_mm=0.0 if rng.random() < 0.6 else float(rng.uniform(0.0, 1.5)),
        motion=level,
        interleave=int(rng.integers(1, 4)),
        oblique_deg=float(rng.choice([0.0, 5.0, 15.0])),
        profile="box" if rng.random() < 0.7 else "gaussian",
        snr=float(np.exp(rng.uniform(np.log(12), np.log(60)))),
        bias=float(rng.uniform(0, 0.1)),
        gain_deviation=float(rng.uniform(0, 0.06)),
    )
    return [
        replace(common, orientation="random" if rng.random() < 0.1 else orthogonal[(first + n) % 3])
        for n in range(n_stacks)
    ]


class HeadPatchSampler(tio.data.PatchSampler):
    """Patches centred on random voxels of the mask and moved back onto the grid; fixed by the subject."""

    def _generate_patches(
        self, subject: Any, num_patches: int | None = None
    ) -> Generator[tio.Subject, None, None]:
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
