"""Votes of the masks of slices for each voxel, and the share of it that they call brain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.acquisition.coverage import UNSEEN_BELOW, coverage
from g3r.acquisition.foreground import Foreground
from g3r.acquisition.least_squares import solve_volume
from g3r.acquisition.orientations import votes_per_stack
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
"""Coverage below which a voxel is out of reach, as a share of the average coverage of one stack. With the smoothing
over half the slice spacing, seen voxels end 0.75 of the spacing beyond a stack's last slice."""

POSSIBLE_MM = 1.6
"""How far beyond the mask voxels out of reach may be shown. Beyond all slices, at the border of the grid, the network
is unreliable: it may show a slab there, with a brain probability of 0.25 to 0.5, around the end of the brain stem."""


@dataclass(frozen=True, kw_only=True)
class Votes:
    """Votes of the masks of slices in place for each voxel, before the brain share is computed.

    Attributes:
        slices: K slices in place.
        grid: of the maps.
        weight: [K] slice weights, smaller for slices of parallel stacks (`votes_per_stack`).
        brain, core, out_of_reach, thin: see `Foreground`.
        density: [I, J, K] of slices over each voxel (`coverage`).
        rough: [I, J, K] share of the slices over a voxel whose masks contain it.
        slice_spacing_voxels: the largest slice spacing of the stacks.
    """

    slices: Slices
    grid: VolumeGrid
    weight: NDArray[np.float64]
    brain: NDArray[np.bool_]
    core: NDArray[np.bool_]
    out_of_reach: NDArray[np.bool_]
    thin: NDArray[np.bool_]
    density: NDArray[np.float32]
    rough: NDArray[np.float32]
    slice_spacing_voxels: float

    @classmethod
    def of(cls, slices: Slices, grid: VolumeGrid, weight: NDArray[np.floating] | None = None) -> Votes:
        """Count the votes; see `foreground`."""
        counts = np.ones(len(slices)) if weight is None else np.asarray(weight, dtype=np.float64)
        operator = VoxelOperator(slices.planes, grid, slices.pixel_index, (1, 1, 5))
        voice = counts * votes_per_stack(slices)
        amount = slices.pixel_volume_mm3 * voice / grid.voxel_volume_mm3
        inside = operator.adjoint(amount[operator.plane].astype(np.float32))
        density = coverage(slices, grid, counts)
        voices = density if np.array_equal(voice, counts) else coverage(slices, grid, voice)
        stacks = [slices.take(slices.stack_id == stack) for stack in np.unique(slices.stack_id)]
        spacing_mm = np.array([slice_spacing_mm(stack) for stack in stacks])
        slice_spacing_voxels = float(spacing_mm.max() / grid.spacing_mm.mean())
        sigma = 0.5 * slice_spacing_voxels
        thin = density < 2 * UNSEEN_BELOW * np.median(counts)
        inside, total, voices = (gaussian_filter(one, sigma) for one in (inside, density, voices))
        thickness_mm = np.array([stack.thickness_mm[0] for stack in stacks])
        lone = float((thickness_mm / spacing_mm).min() * np.median(counts))
        seen = total > max(SEEN_SHARE * lone, np.finfo(np.float32).tiny)
        brain = seen & (inside > INSIDE_SHARE * voices)
        if not brain.any():
            raise InputError("no voxel is covered by a slice; check masks and headers")
        rough = np.divide(inside, voices, out=np.zeros_like(voices), where=seen)
        core = seen & (inside > CORE_SHARE * voices)
        return cls(
            slices=slices,
            grid=grid,
            weight=voice,
            brain=brain,
            core=core,
            out_of_reach=~seen,
            thin=thin,
            density=density,
            rough=rough,
            slice_spacing_voxels=slice_spacing_voxels,
        )

    def foreground(self) -> Foreground:
        """The foreground, with the brain share, which takes longer than all else."""
        voxel_mm = float(self.grid.spacing_mm.mean())
        share, rim_voxels = (~self.out_of_reach).astype(np.float32), 1
        if self.slices.n_stacks > 1:
            smooth_voxels = SMOOTH_SHARE * self.slice_spacing_voxels
            share = _sharpened(self.rough, self.slices, self.grid, self.weight, smooth_voxels)
            share = np.where(self.out_of_reach | self.thin, 0, share).clip(0, 1)
        else:
            rim_voxels = max(1, round(SINGLE_RIM_MM / voxel_mm))
        possible_voxels = max(1, round(POSSIBLE_MM / voxel_mm))
        return Foreground(
            brain=self.brain,
            core=self.core,
            share=share,
            out_of_reach=self.out_of_reach,
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
