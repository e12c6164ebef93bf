"""A head with a bright blob in its right, anterior, superior part, and the corner of a picture that shows it."""

from __future__ import annotations

import base64
import io
import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from g3r.acquisition.images import save_volume
from g3r.geometry import VolumeGrid

SIDES = {
    "axial": {"left": "R", "right": "L", "top": "A", "bottom": "P"},
    "coronal": {"left": "R", "right": "L", "top": "S", "bottom": "I"},
    "sagittal": {"left": "A", "right": "P", "top": "S", "bottom": "I"},
}
"""Anatomical sides of the picture of each section in radiological convention."""

DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "A": (0, 1, 0), "P": (0, -1, 0), "S": (0, 0, 1), "I": (0, 0, -1)}
EXTENTS_MM = np.array([80, 100, 70])
SPACING_MM = 2.0
CENTER_MM = np.array([5.0, -7.0, 3.0])


def grid_of(axes: str) -> VolumeGrid:
    """The grid of one head stored with the given axes, such as "LPS" if the first index grows to the left."""
    directions = np.column_stack([DIRECTIONS[letter] for letter in axes]).astype(float)
    n_i, n_j, n_k = (np.abs(directions.T) @ EXTENTS_MM / SPACING_MM).astype(int).tolist()
    affine = np.eye(4)
    affine[:3, :3] = SPACING_MM * directions
    affine[:3, 3] = CENTER_MM - affine[:3, :3] @ (np.array([n_i, n_j, n_k]) - 1) / 2
    return VolumeGrid((n_i, n_j, n_k), affine)


def blob(grid: VolumeGrid) -> NDArray[np.float32]:
    """A bright blob [I, J, K] right, anterior and superior of the centre, large enough to cross the three planes."""
    place = grid.world(np.moveaxis(np.indices(grid.shape), 0, -1))
    half_mm = np.abs(grid.affine[:3, :3]) @ (np.array(grid.shape) - 1) / 2
    away = (place - grid.center_mm) / half_mm - 0.4
    return 100 * (np.linalg.norm(away, axis=-1) < 0.6).astype(np.float32)


def brain(grid: VolumeGrid) -> NDArray[np.bool_]:
    """Mask of a grid without its outermost voxels."""
    inside = np.zeros(grid.shape, dtype=bool)
    inside[1:-1, 1:-1, 1:-1] = True
    return inside


def with_planted_head(finished: Path, folder: Path, axes: str) -> Path:
    """A copy of an output folder that shows only this head, stored with the given axes."""
    shutil.copytree(finished, folder)
    for path in folder.glob("*.nii.gz"):
        path.unlink()
    grid = grid_of(axes)
    save_volume(folder / "volume.nii.gz", blob(grid), grid.affine)
    save_volume(folder / "mask.nii.gz", brain(grid), grid.affine)
    return folder


def section_of(picture: str) -> NDArray[np.floating]:
    """Grey values of a base64-encoded PNG."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(picture))).convert("L")).astype(float)


def bright_corner(pixels: NDArray[np.floating]) -> str:
    """Corner of a picture [H, W] with the bright part, such as "top left"; "middle" means neither side."""
    rows, columns = np.nonzero(pixels > 200)
    assert len(rows) > 0.03 * pixels.size, "there is no blob in the picture"
    down, across = rows.mean() / pixels.shape[0] - 0.5, columns.mean() / pixels.shape[1] - 0.5
    vertical = "middle" if abs(down) < 0.05 else "bottom" if down > 0 else "top"
    return f"{vertical} {'middle' if abs(across) < 0.05 else 'right' if across > 0 else 'left'}"
