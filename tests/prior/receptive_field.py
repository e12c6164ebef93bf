"""How far the prior network can see, from the extents of its layers."""

from g3r.prior.config import PriorNetworkConfig


def receptive_radius_voxels(config: PriorNetworkConfig) -> int:
    """How far, in full-resolution voxels, a change of the input can reach in the output."""
    radius = 2  # the two convolutions at full resolution
    for level, count in enumerate(config.units):
        per_voxel = 2 ** (level + 1)
        is_deepest = level + 1 == len(config.units)
        entry_and_units = 1 + 2 * count * (1 if is_deepest else 2)
        radius += per_voxel * entry_and_units
        # Being resampled, a voxel also stands for its whole block.
        radius += per_voxel
    return radius
