"""The grid that registration works on."""

from __future__ import annotations

from g3r.acquisition.planes import Slices
from g3r.geometry import VolumeGrid


def grid_around(slices: Slices, spacing_mm: float, margin_mm: float = 6.0) -> VolumeGrid:
    """The axis-aligned grid that covers every masked pixel and a margin."""
    points = slices.planes.pixel_world_mm(slices.pixel_index)
    return VolumeGrid.isotropic(points.min(0), points.max(0), spacing_mm, margin_mm)
