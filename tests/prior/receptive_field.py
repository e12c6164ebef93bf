"""Receptive field of the prior network, from the extents of its layers."""

from g3r.prior.config import PriorNetworkConfig


def receptive_radius_voxels(config: PriorNetworkConfig) -> int:
    """Largest distance, in full-resolution voxels, from a change of the input to its effect on the output."""
    radius = 2  # the two convolutions at full resolution
    for level, count in enumerate(config.units):
        per_voxel = 2 ** (level + 1)
        is_deepest = level + 1 == len(config.units)
        entry_and_units = 1 + 2 * count * (1 if is_deepest else 2)
        radius += per_voxel * entry_and_units
        # A resampled voxel also represents its whole block.
        radius += per_voxel
    return radius
