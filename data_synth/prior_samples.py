"""Training samples of the prior network: a head is sliced with pose errors and spread back to V_coarse and M_rho."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from data_synth.artefacts import with_artefacts
from data_synth.atlas import TruthVolume, cropped
from data_synth.augment import augmentation, augmented
from data_synth.heads import USUAL_WEEKS, Subject, load_volume_of, weeks_of
from data_synth.mask_errors import SKULL_RIM_SHARE, SMALL_MASK_SHARE, with_mask_errors, with_skull_rim
from data_synth.protocol_sampling import draw_settings
from data_synth.registration_errors import ResidualKind, draw_residual_kind, mean_motion, residual_errors
from data_synth.simulator import SimulatedStack, StackSettings, simulate_stacks
from data_synth.subject_cache import SubjectCache, SyntheticSubject
from data_synth.subject_dataset import SubjectDataset
from data_synth.template import HALF_WINDOW_WEEKS
from data_synth.uneven_coverage import with_uneven_coverage
from g3r.acquisition.atlas_template import AtlasTemplate, PlacedHead
from g3r.acquisition.coarse_volume import coarse_and_density, normalisation_scale
from g3r.acquisition.coverage import brain_share, coverage
from g3r.acquisition.least_squares import sharpened_volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.template_fit import fit_template
from g3r.geometry import RigidPose, VolumeGrid

IMAGE_KEYS = ("coarse", "density", "share", "sharp", "template", "outline", "truth", "mask")
Patches = dict[str, Tensor]
"""`IMAGE_KEYS` float32 [P, 1, I, J, K], `n_stacks` int64 [P] and `thickness_mm` float32 [P]."""

MARGIN_VOXELS = 6
"""Background kept around a head, so that the network learns that the background is empty."""
MAX_VALIDATION_STACKS = 3
"""Validation volumes are made from 1, 2, 3 stacks in turn."""
UNKNOWN_MOTION_SHARE = 0.6
"""Probability that the motion between the slices of a single stack is unknown, so that they share one mean motion."""
NOTICED_SHARE = 0.7
"""Probability that a slice without signal has a low weight."""
DISTRUSTED_SHARE = 0.15
"""Probability that registration gave weight zero to a run of up to `DISTRUSTED_SLICES` slices of a subject."""
DISTRUSTED_SLICES = 4

OTHER_AGE_WEEKS = (HALF_WINDOW_WEEKS + 0.5, HALF_WINDOW_WEEKS + 3.5)
"""Range of the age difference between a training subject and its template. A nearer template is a mean of heads with
the subject itself among them; subjects in use never have so similar a template."""
START_DEG, START_MM, START_SCALE = 2.0, 1.5, 0.03
"""Standard deviations of the template's rotation and translation per axis before it is fitted, and of its log size. The
rotation of a head by augmentation (`augment.py`) comes on top."""


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
        in_order: for validation: subjects and numbers of stacks in turn, heads without augmentation, and one patch
            of each from the middle of the grid.
        distinct: number of epochs after which the same subjects are repeated, cut into other patches; 0 for never.
        cache: folder that stores synthetic subjects; None stores none.
        template: atlas template that is fitted to the seen part of each head.
    """

    def __init__(
        self,
        subjects: Sequence[Subject],
        template: AtlasTemplate,
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
        self.template = template
        self.spacing_mm = spacing_mm
        self.patch_size = patch_size
        self.n_patches = n_patches
        self.artefact_share = artefact_share
        self.distinct = distinct
        self.augmentation = None if in_order else augmentation()
        # everything that determines the subjects, except the code
        made_of = (template.weeks.tolist(), template.volume.shape, float(template.volume.mean()))
        spec = ([one.name for one in subjects], made_of, spacing_mm, seed, patch_size, artefact_share, in_order)
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
        facts = {"n_stacks": one.n_stacks, "thickness_mm": one.thickness_mm}
        return {**patches, **{name: torch.full((len(boxes),), value) for name, value in facts.items()}}

    def sample(self, epoch: int, index: int) -> SyntheticSubject:
        """The whole volumes of subject (epoch, index)."""
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
        n_stacks = 1 + self.turn(index, MAX_VALIDATION_STACKS) if self.in_order else None
        head = self._template_head(weeks_of(self.subjects[which], USUAL_WEEKS), rng)
        return synthesise(truth, head, rng, n_stacks, self.artefact_share)

    def _template_head(self, weeks: float, rng: np.random.Generator) -> PlacedHead:
        """The template to fit: nearest in age for validation, and of another age for training.

        Where none is as far away as `OTHER_AGE_WEEKS` asks for, it is the nearest beyond, or else the furthest of all:
        nearer ones may be means of few heads with the subject among them, and the network would learn to trust them.
        """
        apart = np.abs(self.template.weeks - weeks)
        nearest, furthest = OTHER_AGE_WEEKS
        others = np.flatnonzero((apart >= nearest) & (apart <= furthest))
        if self.in_order:
            return self.template.head(int(apart.argmin()))
        if len(others):
            return self.template.head(int(rng.choice(others)))
        beyond = np.where(apart > furthest, apart, np.inf)
        return self.template.head(int(beyond.argmin() if np.isfinite(beyond).any() else apart.argmax()))


def patch_corners(mask: NDArray[np.bool_], size: int, n: int, seed: Sequence[int]) -> list[NDArray[np.int64]]:
    """First voxels of patches that are centred on random voxels of a mask and shifted to lie within the grid.

    Args:
        mask: [I, J, K], at least `size` voxels along each axis.
        size: edge of a patch in voxels.
        n: number of patches.
        seed: of the random voxels.
    """
    rng = np.random.default_rng(seed)
    center = np.stack(np.unravel_index(rng.choice(np.flatnonzero(mask), n), mask.shape), axis=-1)
    return list(np.clip(center - size // 2, 0, np.array(mask.shape) - size))


def synthesise(
    truth: TruthVolume,
    template: PlacedHead,
    rng: np.random.Generator,
    n_stacks: int | None = None,
    artefact_share: float = 0.0,
) -> SyntheticSubject:
    """Synthesise one training subject from a truth volume: stacks with random settings, pose errors, coarse volume.

    V_coarse is that of Eq. 6.

    Args:
        truth: the head.
        template: in the atlas frame, to be fitted to the seen part of the head.
        rng: source of randomness.
        n_stacks: number of stacks; None draws it.
        artefact_share: see `with_artefacts`.

    Raises:
        InputError: a stack shows nothing of the head (as for a volume with an almost empty mask).
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
    stacks = with_uneven_coverage(stacks, rng)
    slices = slices_from_stacks([one.stack for one in stacks])
    grid = VolumeGrid(truth.data.shape, truth.affine)
    found = _registered_poses(stacks, settings, slices, grid.center_mm, residual, rng)
    slice_weight = _slice_weights(stacks, slices, rng)
    weight = slice_weight[slices.pixel_plane]
    slices = slices.with_pose(found)
    coarse, masked = coarse_and_density(slices, grid, weight=weight)
    density = coverage(slices, grid, slice_weight)
    share = brain_share(masked, density)
    sharp = sharpened_volume(slices, grid, coarse, weight=weight)
    scale = np.float32(normalisation_scale(coarse, masked))
    inside = np.where(truth.mask, truth.data, 0) / scale
    sharp = sharp / scale
    fitted = fit_template(_placed(template, truth, rng), sharp, share, density, grid)
    return SyntheticSubject(
        coarse=coarse / scale,
        density=density,
        share=share,
        sharp=sharp,
        template=fitted.values,
        outline=fitted.inside,
        truth=inside.astype(np.float32),
        mask=truth.mask,
        n_stacks=slices.n_stacks,
        thickness_mm=float(slices.thickness_mm.mean()),
    )


def _placed(template: PlacedHead, truth: TruthVolume, rng: np.random.Generator) -> PlacedHead:
    """The template, placed at the head with about the error of a registration."""
    head_grid = VolumeGrid(truth.data.shape, truth.affine)
    here, there = head_grid.world(np.argwhere(truth.mask)), template.grid.world(np.argwhere(template.volume > 0))
    size_mm, template_size_mm = ((points - points.mean(0)).std() for points in (here, there))
    scale = size_mm / template_size_mm * np.exp(rng.normal(0, START_SCALE))
    turn = Rotation.from_rotvec(np.deg2rad(rng.normal(0, START_DEG, 3))).as_matrix()
    affine = np.eye(4)
    affine[:3, :3] = scale * turn @ template.grid.affine[:3, :3]
    shift_mm = here.mean(0) + rng.normal(0, START_MM, 3)
    affine[:3, 3] = shift_mm + scale * turn @ (template.grid.affine[:3, 3] - template.center_mm)
    return PlacedHead(template.volume, VolumeGrid(template.grid.shape, affine), shift_mm)


def _registered_poses(
    stacks: Sequence[SimulatedStack],
    settings: Sequence[StackSettings],
    slices: Slices,
    center_mm: NDArray[np.float64],
    residual: ResidualKind,
    rng: np.random.Generator,
) -> RigidPose:
    """Poses for the coarse volume: true poses with registration errors; a single stack often has one common motion."""
    true_pose = _per_slice(stacks, slices.stack_id, slices.slice_index)
    motion = true_pose
    no_jerks = settings[0].motion.n_jerks == 0  # jerks are found by registration even in a single stack
    if len(stacks) == 1 and no_jerks and residual != "gross" and rng.random() < UNKNOWN_MOTION_SHARE:
        motion = mean_motion(true_pose, center_mm)
    exact = motion @ slices.planes.pose
    return residual_errors(residual, slices.stack_id, exact.translation_mm, rng) @ exact


def _slice_weights(stacks: Sequence[SimulatedStack], slices: Slices, rng: np.random.Generator) -> NDArray[np.float64]:
    """Weight [K] of each slice: low for most slices without signal; in some subjects zero for a run of slices."""
    dropout = np.array([stacks[s].dropout[k] for s, k in zip(slices.stack_id, slices.slice_index, strict=True)])
    noticed = dropout & (rng.random(len(dropout)) < NOTICED_SHARE)
    weight = np.where(noticed, rng.uniform(0, 0.3, len(dropout)), 1.0)
    if rng.random() < DISTRUSTED_SHARE and len(slices) > 3 * DISTRUSTED_SLICES:
        first = int(rng.integers(len(slices) - DISTRUSTED_SLICES))
        weight[first : first + int(rng.integers(1, DISTRUSTED_SLICES + 1))] = 0
    return weight


def _per_slice(
    stacks: Sequence[SimulatedStack], stack_id: NDArray[np.int64], slice_index: NDArray[np.int64]
) -> RigidPose:
    pairs = list(zip(stack_id, slice_index, strict=True))
    return RigidPose(
        np.stack([stacks[s].true_pose.rotation[k] for s, k in pairs]),
        np.stack([stacks[s].true_pose.translation_mm[k] for s, k in pairs]),
    )


def _padded(volume: TruthVolume, smallest: int) -> TruthVolume:
    """The volume, zero-padded on both sides of each axis that is shorter than `smallest` voxels."""
    missing = np.maximum(smallest - np.array(volume.data.shape), 0)
    if not missing.any():
        return volume
    width = [(int(n) // 2, int(n) - int(n) // 2) for n in missing]
    affine = volume.affine.copy()
    affine[:3, 3] -= affine[:3, :3] @ [before for before, _ in width]
    return TruthVolume(
        name=volume.name, data=np.pad(volume.data, width), mask=np.pad(volume.mask, width), affine=affine
    )
