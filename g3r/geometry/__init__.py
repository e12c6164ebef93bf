"""Rigid poses (`rigid`), voxel grids (`grid`) in float64, and rotations from quaternions in torch (`quaternion`)."""

from g3r.geometry.grid import VolumeGrid
from g3r.geometry.rigid import RigidPose

__all__ = ["RigidPose", "VolumeGrid"]
