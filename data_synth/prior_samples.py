"""Training subjects of the prior network: a head, sliced, mis-registered, scattered back to V_coarse and M_rho."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from data_synth.artefacts import with_artefacts
from data_synth.atlas import TruthVolume, cropped
from data_synth.augment import augmentation, augmented
from data_synth.heads import Subject, load_volume_of
from data_synth.mask_errors import SKULL_RIM_SHARE, SMALL_MASK_SHARE, with_mask_errors, with_skull_rim
from data_synth.protocol_sampling import draw_settings
from data_synth.registration_errors import ResidualKind, draw_residual_kind, mean_motion, residual_errors
from data_synth.simulator import SimulatedStack, StackSettings, simulate_stacks
from data_synth.subject_cache import SubjectCache, SyntheticSubject
from data_synth.subject_dataset import SubjectDataset
from g3r.acquisition.coarse_volume import coarse_and_density, normalisation_scale
from g3r.acquisition.least_squares import sharpened_volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import slices_from_stacks
from g3r.geometry import RigidPose, VolumeGrid

IMAGE_KEYS = ("coarse", "density", "sharp", "truth", "mask")
Patches = dict[str, Tensor]
"""`IMAGE_KEYS` float32 [P, 1, I, J, K] and `n_stacks` int64 [P]."""

MARGIN_VOXELS = 6
"""Background kept around a head: the network must learn that nothing is there."""
MAX_VALIDATION_STACKS = 3
"""Validation volumes are of 1, 2, 3 stacks in turn."""
UNKNOWN_MOTION_SHARE = 0.6
"""How often nothing is known of how the slices of a single stack moved against each other."""
NOTICED_SHARE = 0.7
"""How often a slice without signal has been given a low weight."""


class SyntheticSubjects(SubjectDataset[Patches]):
    """Patches of subjects synthesised on the fly.

    Args:
        subjects: atlas subjects or phantoms.
        spacing_mm: voxel size.
        length: subjects per epoch.
        seed: of the whole dataset.
        patch_size: edge of a patch; grids are padded to at least this many voxels per axis.
        n_patches: patches of each subject, centred on random voxels of the mask.
        artefact_share: see `with_artefacts`.
        in_order: for validation: subjects and numbers of stacks in turn, heads as they are, and one patch of each,
            from the middle of the grid.
        distinct: after this many epochs the same subjects come again, cut into other patches; 0 for never.
        cache: folder that keeps subjects once made; None keeps none.
    """

    def __init__(
        self,
        subjects: Sequence[Subject],
        *,
        spacing_mm: float,
        length: int,
        seed: int,
        patch_size: int,
        n_patches: int = 1,
        artefact_share: float = 0.0,
        in_order: bool = False,
        distinct: int = 0,
        cache: str | Path | None = None,
    ) -> None:
        super().__init__(subjects, length, seed, in_order)
        self.spacing_mm = spacing_mm
        self.patch_size = patch_size
        self.n_patches = n_patches
        self.artefact_share = artefact_share
        self.distinct = distinct
        self.augmentation = None if in_order else augmentation()
        # all that decides the subjects, apart from the code
        spec = ([one.name for one in subjects], spacing_mm, seed, patch_size, artefact_share, in_order)
        self.cache = SubjectCache(cache, repr(spec)) if cache is not None else None

    def make(self, epoch: int, index: int) -> Patches:
        """The patches of subject (epoch, index)."""
        one = self.sample(epoch, index)
        first = [(np.array(one.truth.shape) - self.patch_size) // 2]
        if not self.in_order:
            first = patch_corners(one.mask, self.patch_size, self.n_patches, [self.seed, epoch, index, 1])
        boxes = [tuple(slice(a, a + self.patch_size) for a in corner) for corner in first]
        images = {key: np.stack([getattr(one, key)[box] for box in boxes])[:, None] for key in IMAGE_KEYS}
        patches = {key: torch.from_numpy(image.astype(np.float32, copy=False)) for key, image in images.items()}
        return {**patches, "n_stacks": torch.full((len(boxes),), one.n_stacks)}

    def sample(self, epoch: int, index: int) -> SyntheticSubject:
        """Subject (epoch, index), whole."""
        if self.distinct:
            epoch %= self.distinct
        found = None if self.cache is None else self.cache.load(epoch, index)
        if found is None:
            found = self._synthesise(epoch, index)
            if self.cache is not None:
                self.cache.save(epoch, index, found)
        return found

    def load(self, subject: Subject) -> TruthVolume:
        """The subject's normalised volume with a margin."""
        return cropped(load_volume_of(subject, self.spacing_mm), MARGIN_VOXELS + 4)

    def _synthesise(self, epoch: int, index: int) -> SyntheticSubject:
        which, rng = self.draw(epoch, index)
        truth = self.volume(which)
        if self.augmentation is not None:
            truth = augmented(truth, self.augmentation, rng)
        truth = _padded(cropped(truth, MARGIN_VOXELS), self.patch_size)
        n_stacks = 1 + index % MAX_VALIDATION_STACKS if self.in_order else None
        return synthesise(truth, rng, n_stacks, self.artefact_share)


def patch_corners(mask: NDArray[np.bool_], size: int, n: int, seed: Sequence[int]) -> list[NDArray[np.int64]]:
    """First voxels of patches centred on random voxels of a mask and moved back onto the grid.

    Args:
        mask: [I, J, K], at least `size` voxels along each axis.
        size: edge of a patch in voxels.
        n: number of patches.
        seed: decides them.
    """
    rng = np.random.default_rng(seed)
    center = np.stack(np.unravel_index(rng.choice(np.flatnonzero(mask), n), mask.shape), axis=-1)
    return list(np.clip(center - size // 2, 0, np.array(mask.shape) - size))


def synthesise(
    truth: TruthVolume, rng: np.random.Generator, n_stacks: int | None = None, artefact_share: float = 0.0
) -> SyntheticSubject:
    """One training subject from a truth volume: stacks with random settings, pose errors, G3R Eq. 6.

    Args:
        truth: the head.
        rng: source of randomness.
        n_stacks: drawn when None.
        artefact_share: see `with_artefacts`.

    Raises:
        InputError: no head moved into view in any draw (volumes with an all but empty mask).
    """
    residual = draw_residual_kind(rng)
    settings = draw_settings(residual, rng, n_stacks)
    kind = rng.random()
    seen = with_skull_rim(truth, rng) if kind < SKULL_RIM_SHARE else truth
    stacks = simulate_stacks(seen.data, seen.mask, seen.affine, settings, rng)
    if artefact_share > 0:
        stacks = with_artefacts(stacks, artefact_share, rng.spawn(1)[0])
    if kind < SKULL_RIM_SHARE + SMALL_MASK_SHARE:
        stacks = with_mask_errors(stacks, rng, grow=kind < SKULL_RIM_SHARE)
    slices = slices_from_stacks([one.stack for one in stacks])
    grid = VolumeGrid(truth.data.shape, truth.affine)
    found = _registered_poses(stacks, settings, slices, grid.center_mm, residual, rng)
    weight = _pixel_weights(stacks, slices, rng)
    slices = slices.with_pose(found)
    coarse, density = coarse_and_density(slices, grid, weight=weight)
    sharp = sharpened_volume(slices, grid, coarse, weight=weight)
    scale = np.float32(normalisation_scale(coarse, density))
    inside = np.where(truth.mask, truth.data, 0) / scale
    return SyntheticSubject(
        coarse=coarse / scale,
        density=density,
        sharp=sharp / scale,
        truth=inside.astype(np.float32),
        mask=truth.mask,
        affine=truth.affine,
        name=truth.name,
        n_stacks=len(stacks),
        residual=residual,
    )


def _registered_poses(
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
    if len(stacks) == 1 and no_jerks and residual != "gross" and rng.random() < UNKNOWN_MOTION_SHARE:
        motion = mean_motion(true_pose, center_mm)
    exact = motion @ slices.planes.pose
    return residual_errors(residual, slices.stack_id, exact.translation_mm, rng) @ exact


def _pixel_weights(stacks: Sequence[SimulatedStack], slices: Slices, rng: np.random.Generator) -> NDArray[np.float64]:
    """Weight of each masked pixel: registration mostly notices slices without signal."""
    dropout = np.array([stacks[s].dropout[k] for s, k in zip(slices.stack_id, slices.slice_index, strict=True)])
    noticed = dropout & (rng.random(len(dropout)) < NOTICED_SHARE)
    return np.where(noticed, rng.uniform(0, 0.3, len(dropout)), 1.0)[slices.pixel_plane]


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
    return TruthVolume(
        name=volume.name, data=np.pad(volume.data, width), mask=np.pad(volume.mask, width), affine=affine
    )
