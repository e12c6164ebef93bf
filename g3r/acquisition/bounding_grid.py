"""The voxel grid around posed slices."""

from __future__ import annotations

import numba
import numpy as np

from g3r.acquisition.planes import Slices
from g3r.geometry import VolumeGrid


def grid_around(slices: Slices, spacing_mm: float, margin_mm: float = 6.0) -> VolumeGrid:
    """The axis-aligned grid that covers every masked pixel and a margin.

    Args:
        slices: at their present poses.
        spacing_mm: edge of the voxels.
        margin_mm: added on every side.

    Raises:
        ValueError: no pixel is masked.
    """
    planes = slices.planes
    if not slices.mask.any():
        raise ValueError("no pixel is masked")
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    _bounds(slices.mask, planes.offset, planes.shape, planes.spacing_mm, planes.rotation, planes.center_mm, low, high)
    return VolumeGrid.isotropic(low, high, spacing_mm, margin_mm)


@numba.njit(nogil=True, cache=True)
def _bounds(mask, offset, shape, spacing, rotation, center, low, high):
    """Least and largest world coordinates of masked pixels; only the ends of a row can be extreme."""
    for k in range(len(shape)):
        n_x, n_y = shape[k, 0], shape[k, 1]
        for x in range(n_x):
            row = offset[k] + x * n_y
            first, last = 0, n_y - 1
            while first < n_y and not mask[row + first]:
                first += 1
            if first == n_y:
                continue
            while not mask[row + last]:
                last -= 1
            u = (x - (n_x - 1) / 2) * spacing[k, 0]
            for y in (first, last):
                v = (y - (n_y - 1) / 2) * spacing[k, 1]
                for axis in range(3):
                    position = center[k, axis] + rotation[k, axis, 0] * u + rotation[k, axis, 1] * v
                    low[axis], high[axis] = min(low[axis], position), max(high[axis], position)
