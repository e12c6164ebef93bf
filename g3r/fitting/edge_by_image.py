"""The edge of the volume by the image, in stacks that are black beside the brain.

A mask says only which pixels have their middle in the brain, and the volume that is fitted to them goes on beyond it as
if there were brain. Where nothing but black lies beside the brain, a pixel of the rim shows how much brain is beneath
it: its value over the value that it would have if all beneath it were brain. The share f of brain in the voxels
minimises

    sum_p w_p (A f - y / A V)_p^2  +  r s |grad f|

over masked pixels and those beside them, with V the volume, continued beyond its edge. Total variation keeps the edge
sharp. Dark pixels count like bright ones: V is a guess there, and wrong by a proportion more than by noise. Where
stacks show skull, fluid and mother, nothing is found, and masks alone decide (`acquisition.foreground`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from g3r.acquisition.cut_images import cut_at_mask
from g3r.acquisition.planes import Slices
from g3r.fitting.slice_stage import SliceFit
from g3r.fitting.voxel_problem import FitPixels, Float32Array, VoxelProblem, VoxelProblemSettings, too_fine
from g3r.geometry import VolumeGrid

SHARES = (0.2, 0.5)
"""Shares of brain between which the volume fades in. On eight development cases (docs/method.md, "Mask") half of a
voxel, where the edge lies, would be best on the whole grid; but a voxel of the brain that is lost costs more."""

SETTINGS = VoxelProblemSettings(hold=0.003, total_variation=0.13, tip=0.05, n_rounds=3, n_iterations=10)

FULL_MM = 1.1
"""Deeper inside the support than this, the volume is shown in full: what is dark there is fluid."""

CONTINUED_MM = 1.5
"""Standard deviation of the Gaussian mean that continues the volume beyond its edge."""

OUTSIDE_MM, INSIDE_MM = 4.6, 5.6
"""Distances from the edge, outside and inside, up to which pixels are used."""

BESIDE_MM = (2.6, 9.6)
"""Distances from the edge: pixels between the two outside show whether anything lies beside the brain, and pixels
deeper inside than the first show the brain."""

BRIGHT_SHARE, MAX_BRIGHT = 0.3, 0.05
"""Share of the median in the brain below which a pixel is noise, and largest share of pixels beside the brain that may
be brighter. Simulated brain-extracted stacks have 0.00 to 0.01."""

NOISE_TOP, MAX_NOISE_TOP = 3.0 / 1.18, 0.65
"""Top of the noise over the median beside the brain, and its largest share of the median in the brain. Noise in black
has a Rayleigh distribution, whose median is 1.18 standard deviations: one pixel in a hundred is brighter than three
standard deviations, which may be more than `BRIGHT_SHARE` of the brain, at an SNR of 5 twice as much. If the median
beside the brain is brighter, it is not noise."""

LEAST_PREDICTED = 0.1
"""Prediction, in normalised intensities, below which a pixel shows no share."""


def shown_by_image(
    volume: Float32Array,
    edge: NDArray[np.floating],
    support: NDArray[np.bool_],
    grid: VolumeGrid,
    fit: SliceFit,
    acquired: Slices,
) -> Float32Array | None:
    """How much of the volume is to be shown [I, J, K]; None if something lies beside the brain, or voxels are too fine.

    Args:
        volume: [I, J, K] as it is, faded by `edge`.
        edge: [I, J, K] from 0 to 1.
        support: [I, J, K] bool, where it was fitted.
        grid: of all these.
        fit: slices with profiles, poses, gains and fields.
        acquired: the same slices with the values as acquired, unmasked pixels of their boxes included.
    """
    if too_fine(float(grid.spacing_mm.min()), acquired):
        return None
    depth_mm = _depth_mm(support, grid)
    pixels = _around(fit, acquired, depth_mm, grid)
    if pixels is None:
        return None
    predicted = pixels.operator(grid).forward(_continued(volume, edge, depth_mm, grid))
    asked = replace(
        pixels,
        value=np.clip(pixels.value / np.maximum(predicted, LEAST_PREDICTED), 0, 1.2).astype(np.float32),
        weight=np.where(predicted > LEAST_PREDICTED, pixels.weight, 0).astype(np.float32),
    )
    share = VoxelProblem(asked, grid, SETTINGS).solved(edge.astype(np.float32))
    low, high = SHARES
    shown = np.clip((share - low) / (high - low), 0, 1)
    outermost_mm = 0.5 * float(grid.spacing_mm.max())
    return np.where(depth_mm > max(FULL_MM, outermost_mm), 1, shown).astype(np.float32)


def _depth_mm(support: NDArray[np.bool_], grid: VolumeGrid) -> Float32Array:
    """Distance [I, J, K] from the edge of the support, positive inside.

    What is measured is the way to the next voxel of the other side; the edge lies half a voxel before its middle.
    """
    half_mm = 0.5 * float(grid.spacing_mm.min())
    inside, outside = (distance_transform_edt(part, sampling=grid.spacing_mm) for part in (support, ~support))
    return np.where(support, inside - half_mm, half_mm - outside).astype(np.float32)


def _around(fit: SliceFit, acquired: Slices, depth_mm: Float32Array, grid: VolumeGrid) -> FitPixels | None:
    """Pixels near the edge, masked or not; None if something lies beside the brain, or if no pixel shows it.

    Zeros beyond the masks of images that were cut there show nothing (`acquisition.cut_images`).
    """
    slices = replace(fit.slices, value=acquired.value, mask=np.ones_like(acquired.mask))
    pixels = FitPixels.of(fit, slices, np.ones(len(slices.value), np.float32))
    place = grid.index(slices.planes.pixel_world_mm()).T
    depth = map_coordinates(depth_mm, place, order=1, mode="nearest")
    measured = acquired.mask | ~cut_at_mask(acquired)[pixels.plane]
    pixels, depth = pixels.take(measured), depth[measured]
    near, far = BESIDE_MM
    brain, beside = pixels.value[depth > near], pixels.value[(depth < -near) & (depth > -far)]
    if not len(brain) or not len(beside):
        return None
    usual = float(np.median(brain))
    noise_top = NOISE_TOP * float(np.median(beside))
    if usual <= 0 or noise_top > MAX_NOISE_TOP * usual:
        return None
    if (beside > max(BRIGHT_SHARE * usual, noise_top)).mean() > MAX_BRIGHT:
        return None
    return pixels.take((depth > -OUTSIDE_MM) & (depth < INSIDE_MM))


def _continued(
    volume: Float32Array, edge: NDArray[np.floating], depth_mm: Float32Array, grid: VolumeGrid
) -> Float32Array:
    """The volume [I, J, K] as if it had no edge."""
    counts = np.where(depth_mm > 0, edge, 0).astype(np.float32)
    width = CONTINUED_MM / grid.spacing_mm
    weight = gaussian_filter(counts * counts, width)
    around = np.divide(gaussian_filter(volume * counts, width), weight, out=np.zeros_like(volume), where=weight > 1e-3)
    return np.where(depth_mm > 0.5 * float(grid.spacing_mm.max()), volume, around).astype(np.float32)
