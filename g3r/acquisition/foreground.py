"""The brain mask of the volume, from the masks of slices where slices looked, and by shape where none did.

A voxel is in one of three states: seen and called brain, seen and called something else, or unseen. The masks say
nothing about unseen voxels: shape decides there (the prior network's brain probability, or the hull of the seen brain),
never the absence of a mask.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_fill_holes, gaussian_filter, label
from scipy.spatial import ConvexHull, QhullError

from g3r.acquisition.coverage import UNSEEN_BELOW, coverage
from g3r.acquisition.least_squares import solve_volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import slice_spacing_mm
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.errors import InputError
from g3r.geometry import VolumeGrid

INSIDE_SHARE = 1 / 3
"""Share of the slices over a voxel whose masks must contain it, for the volume to be fitted there: one of three stacks.
At one half some outermost voxels are lost, and with them 1 to 4 dB. One third is too large by about a quarter of the
slice spacing (docs/method.md, "Mask")."""

CORE_SHARE = 1 / 2
"""The same share for the written mask. One half is the edge of a mask, so that the mask's volume is right."""

EDGE = (0.03, 0.15)
"""Brain shares between which the volume fades in. Voxels below the first hold next to no brain."""

SINGLE_RIM_MM = 1.6
"""How far the volume of a single stack is shown beyond the support: its slices may lie a millimetre off, and no other
stack shows where the brain ends."""

MASK_WIDTH = 0.5
"""Width of the profile of a mask over that of its slice: a mask is drawn by where the middle of a pixel lies."""

SMOOTH_SHARE = 0.18
"""Smoothing length of the brain share over the slice spacing."""

N_ITERATIONS = 4
"""Conjugate-gradient steps for the brain share, from a start that is nearly right."""

SEEN_SHARE = 1 / 3
"""Coverage below which a voxel is unseen, as a share of the average coverage of one stack. With the smoothing over half
the slice spacing, seen voxels end 0.75 of the spacing beyond a stack's last slice."""

POSSIBLE_MM = 1.6
"""How far beyond the mask unseen voxels may be shown. Beyond all slices, at the border of the grid, the network is
unreliable: it may show a slab there, with a brain probability of 0.25 to 0.5, around the end of the brain stem."""

THIN_MARGIN_VOXELS = 2

FLAT = 1e-6
"""Tolerance in voxels: a voxel that is nearer to a face of the hull lies on it."""

LIKELY, POSSIBLE = 0.5, 0.25
"""Brain probability above which an unseen voxel is in the mask, and above which it is shown. The second is lower: a rim
voxel that is left out costs as much as many that are a little wrong."""


@dataclass(frozen=True, kw_only=True)
class Foreground:
    """State of each voxel by the slices and their masks.

    Attributes:
        brain: [I, J, K] seen, and brain by more than a third of the slices.
        core: [I, J, K] seen, and brain by more than half of the slices.
        share: [I, J, K] from 0 to 1, how much of a voxel is brain by the masks; 0 where it is hardly seen. With a
            single stack the share is not known; it is 1 in all voxels that are seen.
        unseen: [I, J, K] not seen.
        thin: [I, J, K] hardly seen or unseen, gaps between slices included.
        rim_voxels: how far the volume is shown beyond the support, at most.
        possible_voxels: how far beyond the mask the support may reach where no slice looked.
    """

    brain: NDArray[np.bool_]
    core: NDArray[np.bool_]
    share: NDArray[np.float32]
    unseen: NDArray[np.bool_]
    thin: NDArray[np.bool_]
    rim_voxels: int = 1
    possible_voxels: int = 2

    def edge(
        self, support: NDArray[np.bool_], mask: NDArray[np.bool_], brain_probability: NDArray[np.floating] | None = None
    ) -> NDArray[np.float16]:
        """How much of the volume is shown [I, J, K]: 1 in the brain, fading to 0 at its edge.

        Args:
            support: [I, J, K] where the volume is fitted.
            mask: [I, J, K] the brain with its holes filled, shown in full.
            brain_probability: see `mask`; decides where slices hardly looked. Without it the support is shown there.
        """
        low, high = EDGE
        share, full, hardly_seen = self.share, mask, self.unseen | self.thin
        if brain_probability is None:
            full = mask | (hardly_seen & support)
        else:
            share = np.where(hardly_seen, np.maximum(share, brain_probability), share)
        faded = np.clip((share - low) / (high - low), 0, 1)
        near = binary_dilation(mask | support, iterations=self.rim_voxels)
        return np.maximum(faded * near, full).astype(np.float16)

    def support(self, brain_probability: NDArray[np.floating] | None = None) -> NDArray[np.bool_]:
        """Where the volume is fitted and shown [I, J, K]: the mask with a margin of about a voxel.

        With a network the margin is wider where slices hardly looked; `edge` hides what is no brain there.

        Args:
            brain_probability: see `mask`.
        """
        brain = self._completed(self.brain, brain_probability, POSSIBLE)
        if brain_probability is None:
            return brain
        if self.unseen.any():
            near = binary_dilation(self.mask(brain_probability), iterations=self.possible_voxels)
            brain &= near | ~self.unseen
        return brain | (self.thin & binary_dilation(brain, iterations=THIN_MARGIN_VOXELS))

    def mask(self, brain_probability: NDArray[np.floating] | None = None) -> NDArray[np.bool_]:
        """The brain mask [I, J, K]: the seen brain, and the unseen voxels that are brain by shape.

        Only the largest connected piece is kept, and its holes are filled.

        Args:
            brain_probability: [I, J, K]; without it the convex hull of the seen brain decides.
        """
        return self._completed(self.core if self.core.any() else self.brain, brain_probability, LIKELY)

    def _completed(
        self, seen_brain: NDArray[np.bool_], brain_probability: NDArray[np.floating] | None, least: float
    ) -> NDArray[np.bool_]:
        if not self.unseen.any():
            likely = self.unseen
        elif brain_probability is None:
            likely = _hull(seen_brain, self.unseen)
        else:
            likely = brain_probability > least
        brain = seen_brain | (self.unseen & likely)
        pieces, n_pieces = label(brain)
        if n_pieces > 1:
            brain = pieces == 1 + int(np.argmax(np.bincount(pieces.ravel())[1:]))
        return binary_fill_holes(brain)


@dataclass(frozen=True, kw_only=True)
class Votes:
    """Votes of the masks of slices in place for each voxel, before the brain share is computed.

    Attributes:
        slices: K slices in place.
        grid: of the maps.
        weight: [K] slice weights.
        brain, core, unseen, thin: see `Foreground`.
        density: [I, J, K] of slices over each voxel (`coverage`).
        rough: [I, J, K] share of the slices over a voxel whose masks contain it.
        slice_spacing_voxels: the largest slice spacing of the stacks.
    """

    slices: Slices
    grid: VolumeGrid
    weight: NDArray[np.float64]
    brain: NDArray[np.bool_]
    core: NDArray[np.bool_]
    unseen: NDArray[np.bool_]
    thin: NDArray[np.bool_]
    density: NDArray[np.float32]
    rough: NDArray[np.float32]
    slice_spacing_voxels: float

    @classmethod
    def of(cls, slices: Slices, grid: VolumeGrid, weight: NDArray[np.floating] | None = None) -> Votes:
        """Count the votes; see `foreground`."""
        counts = np.ones(len(slices)) if weight is None else np.asarray(weight, dtype=np.float64)
        operator = VoxelOperator(slices.planes, grid, slices.pixel_index, (1, 1, 5))
        amount = slices.pixel_volume_mm3 * counts / grid.voxel_volume_mm3
        inside = operator.adjoint(amount[operator.plane].astype(np.float32))
        density = coverage(slices, grid, counts)
        stacks = [slices.take(slices.stack_id == stack) for stack in np.unique(slices.stack_id)]
        spacing_mm = np.array([slice_spacing_mm(stack) for stack in stacks])
        slice_spacing_voxels = float(spacing_mm.max() / grid.spacing_mm.mean())
        sigma = 0.5 * slice_spacing_voxels
        thin = density < 2 * UNSEEN_BELOW * np.median(counts)
        inside, total = gaussian_filter(inside, sigma), gaussian_filter(density, sigma)
        thickness_mm = np.array([stack.thickness_mm[0] for stack in stacks])
        lone = float((thickness_mm / spacing_mm).min() * np.median(counts))
        seen = total > max(SEEN_SHARE * lone, np.finfo(np.float32).tiny)
        brain = seen & (inside > INSIDE_SHARE * total)
        if not brain.any():
            raise InputError("no voxel is covered by a slice; check masks and headers")
        rough = np.divide(inside, total, out=np.zeros_like(total), where=seen)
        core = seen & (inside > CORE_SHARE * total)
        return cls(
            slices=slices,
            grid=grid,
            weight=counts,
            brain=brain,
            core=core,
            unseen=~seen,
            thin=thin,
            density=density,
            rough=rough,
            slice_spacing_voxels=slice_spacing_voxels,
        )

    def foreground(self) -> Foreground:
        """The foreground, with the brain share, which takes longer than all else."""
        voxel_mm = float(self.grid.spacing_mm.mean())
        share, rim_voxels = (~self.unseen).astype(np.float32), 1
        if self.slices.n_stacks > 1:
            smooth_voxels = SMOOTH_SHARE * self.slice_spacing_voxels
            share = _sharpened(self.rough, self.slices, self.grid, self.weight, smooth_voxels)
            share = np.where(self.unseen | self.thin, 0, share).clip(0, 1)
        else:
            rim_voxels = max(1, round(SINGLE_RIM_MM / voxel_mm))
        possible_voxels = max(1, round(POSSIBLE_MM / voxel_mm))
        return Foreground(
            brain=self.brain,
            core=self.core,
            share=share,
            unseen=self.unseen,
            thin=self.thin,
            rim_voxels=rim_voxels,
            possible_voxels=possible_voxels,
        )


def foreground(slices: Slices, grid: VolumeGrid, weight: NDArray[np.floating] | None = None) -> Foreground:
    """The foreground of slices in their places.

    The brain share of voxels is the volume whose slices are the masks, found by least squares. The start is the masked
    pixels, spread through their PSF, over the coverage of whole slices, both smoothed over half the slice spacing,
    which closes gaps between neighbouring slices.

    Args:
        slices: K slices in place.
        grid: of the result.
        weight: [K] slice weights, so that misplaced slices have no vote.

    Raises:
        InputError: no voxel is brain.
    """
    return Votes.of(slices, grid, weight).foreground()


def _sharpened(
    rough: NDArray[np.float32], slices: Slices, grid: VolumeGrid, weight: NDArray[np.floating], smooth_voxels: float
) -> NDArray[np.float32]:
    """Minimise sum_p w_p (A f - m)_p^2 + r (smooth |grad f|)^2 for masks m and the mean coverage r of a voxel.

    Args:
        rough: [I, J, K] the start.
        slices: K slices in place.
        grid: of the share.
        weight: [K] slice weights.
        smooth_voxels: smoothing length.
    """
    planes = replace(slices.planes, psf_var_mm2=slices.planes.psf_var_mm2 * MASK_WIDTH**2)
    operator = VoxelOperator(planes, grid, psf_points=(1, 1, 3))  # hardly wider than a voxel
    return solve_volume(
        operator,
        slices.mask.astype(np.float32),
        weight[operator.plane].astype(np.float32),
        start=rough,
        n_iterations=N_ITERATIONS,
        smoothness=smooth_voxels**2,
    )


def _hull(brain: NDArray[np.bool_], asked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The voxels [I, J, K] of `asked` inside the convex hull of a mask; none where the mask is flat.

    Along a line of voxels on the third axis the hull lies between the nearest of its half-spaces on either side. This
    is as exact as a test of every voxel, and a hundred times faster.
    """
    within = np.zeros_like(brain)
    within[:, :, 1:-1] = brain[:, :, :-2] & brain[:, :, 2:]
    surface = np.argwhere(brain & ~within)
    try:
        faces = np.unique(np.round(ConvexHull(surface).equations, 9), axis=0)  # triangles of one plane are one face
    except QhullError:
        return np.zeros(brain.shape, bool)
    i, j = np.indices(brain.shape[:2])
    low, high = np.full(brain.shape[:2], -np.inf), np.full(brain.shape[:2], np.inf)
    for a, b, c, d in faces:
        beyond = a * i + b * j + d
        if abs(c) < FLAT:
            high = np.where(beyond > FLAT, -np.inf, high)
        elif c > 0:
            high = np.minimum(high, -beyond / c)
        else:
            low = np.maximum(low, -beyond / c)
    k = np.arange(brain.shape[2])
    return np.asarray(asked & (k >= low[:, :, None] - FLAT) & (k <= high[:, :, None] + FLAT))
