"""Errors of brain extraction: masks that reach beyond the brain, or miss its outermost voxels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt, gaussian_filter

from data_synth.atlas import TruthVolume
from data_synth.simulator import SimulatedStack

SKULL_RIM_SHARE = 0.3
"""Probability that skull and maternal tissue are visible around the head and masks reach into them."""
RIM_MM, MISSED_MM = 3.0, 1.5
SKULL_MM = 1.5
SMALL_MASK_SHARE = 0.1
"""Probability that masks miss the head's outermost voxels."""


def with_skull_rim(truth: TruthVolume, rng: np.random.Generator) -> TruthVolume:
    """The head with a dark skull and blotchy maternal tissue around it, outside the mask."""
    voxel_mm = float(np.linalg.norm(truth.affine[:3, :3], axis=0).mean())
    away_mm = distance_transform_edt(~truth.mask) * voxel_mm
    blotches = gaussian_filter(rng.standard_normal(truth.data.shape, dtype=np.float32), 4.0 / voxel_mm)
    blotches *= 0.25 / max(float(blotches.std()), 1e-6)
    rim = np.clip(rng.uniform(0.2, 0.9) + blotches, 0, None)
    rim = np.where(away_mm < rng.uniform(0.5, 2.0) * SKULL_MM, rng.uniform(0.05, 0.3), rim)
    return replace(truth, data=np.where(truth.mask, truth.data, rim).astype(np.float32))


def with_mask_errors(stacks: Sequence[SimulatedStack], rng: np.random.Generator, grow: bool) -> list[SimulatedStack]:
    """Stacks whose masks are too large or too small by a few pixels in plane.

    Args:
        stacks: as simulated.
        rng: source of randomness.
        grow: True for masks that reach up to 3 mm into the rim, False for masks that lack up to 1.5 mm of the head.
    """
    result = []
    for one in stacks:
        spacing_mm = float(np.linalg.norm(one.stack.affine[:3, 0]))
        steps = max(1, round(rng.uniform(0.2, 1.0) * (RIM_MM if grow else MISSED_MM) / spacing_mm))
        in_plane = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], bool)[:, :, None]
        change = binary_dilation if grow else binary_erosion
        mask = change(one.stack.mask, in_plane, iterations=steps)
        if mask.any():
            one = replace(one, stack=replace(one.stack, mask=mask))
        result.append(one)
    return result
