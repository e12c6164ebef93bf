"""Stacks of an ellipsoid, for the tests of the foreground."""

from dataclasses import replace

import numpy as np

from g3r.acquisition.mask_votes import foreground
from g3r.acquisition.planes import Slices
from g3r.acquisition.stacks import Stack
from g3r.geometry import VolumeGrid

RADII_MM = np.array([27.0, 32.0, 24.0])
TRUE_MM3 = 4 / 3 * np.pi * RADII_MM.prod()
GRID = VolumeGrid.isotropic([-42] * 3, [42] * 3, 1.5)
WORLD = GRID.world(np.stack(np.meshgrid(*[np.arange(n) for n in GRID.shape], indexing="ij"), -1))
TURNS = (np.eye(3), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]))


def depth(world: np.ndarray) -> np.ndarray:
    """1 at the ellipsoid's centre, 0 on its surface."""
    return 1 - np.linalg.norm(world / RADII_MM, axis=-1)


def ellipsoid_stack(
    turn: np.ndarray = TURNS[0],
    *,
    thickness_mm: float = 3.0,
    gap_mm: float = 0.0,
    left_handed: bool = False,
    low_mm: float = -44.0,
    hole: bool = False,
) -> Stack:
    """A stack that covers the ellipsoid from `low_mm` upwards along its third axis."""
    spacing = np.array([1.2, 1.2, thickness_mm + gap_mm])
    n = np.append(np.full(2, 74), int((44 - low_mm) / spacing[2]))
    axes = turn * ([1, 1, -1] if left_handed else [1, 1, 1])
    affine = np.eye(4)
    affine[:3, :3] = axes * spacing
    corner = np.array([-43.8, -43.8, -44.0 if left_handed else low_mm])
    affine[:3, 3] = axes @ corner
    index = np.stack(np.meshgrid(*[np.arange(k) for k in n], indexing="ij"), -1)
    world = VolumeGrid(tuple(n), affine).world(index)
    mask = depth(world) > 0
    if hole:
        mask &= np.linalg.norm(world, axis=-1) > 5
    image = (100 + index.sum(-1)).astype(np.float32)
    return Stack(image=image, mask=mask, affine=affine, thickness_mm=thickness_mm)


def without(stack: Stack, low_mm: float, high_mm: float) -> Stack:
    """The stack with blank slices between two heights along its third axis (mm)."""
    height = (
        stack.affine[:3, 2]
        / stack.spacing_mm[2]
        @ (stack.affine[:3, 3, None] + stack.affine[:3, 2, None] * np.arange(stack.image.shape[2]))
    )
    image, mask = stack.image.copy(), stack.mask.copy()
    missing = (height > low_mm) & (height < high_mm)
    assert missing.any()
    image[:, :, missing], mask[:, :, missing] = 0, False
    return replace(stack, image=image, mask=mask)


def foreground_mask(slices: Slices, weight: np.ndarray | None = None) -> np.ndarray:
    """The foreground mask without a network for unseen voxels."""
    return foreground(slices, GRID, weight).support()


def volume_of(mask: np.ndarray) -> float:
    return float(mask.sum() * GRID.voxel_volume_mm3)
