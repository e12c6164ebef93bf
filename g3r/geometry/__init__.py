"""Rigid poses (`rigid`) and voxel grids (`grid`), all in float64. Imports nothing of ours."""

from g3r.geometry.grid import VolumeGrid
from g3r.geometry.rigid import RigidPose

__all__ = ["RigidPose", "VolumeGrid"]
