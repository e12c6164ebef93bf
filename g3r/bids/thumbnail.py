"""A small picture of a volume for the page of a cohort: three sections side by side."""

from __future__ import annotations

import io
from pathlib import Path

import nibabel as nib
import numpy as np
from numpy.typing import NDArray


def thumbnail(volume: Path) -> bytes:
    """A PNG of axial, coronal and sagittal sections through the middle of a volume, one pixel per voxel.

    The patient's right is on the left, as in the large picture.

    Args:
        volume: a NIfTI file, 0 outside the brain.

    Raises:
        OSError: it cannot be read.
    """
    from matplotlib.image import imsave

    image = nib.as_closest_canonical(nib.Nifti1Image.from_filename(volume))
    data = np.nan_to_num(np.asarray(image.dataobj, dtype=np.float32))
    i, j, k = _middle(data)
    # canonical axes point right, forward and up; flip both axes of a section for the screen
    sections = [data[:, :, k].T[::-1, ::-1], data[:, j].T[::-1, ::-1], data[i].T[::-1, ::-1]]
    height = max(section.shape[0] for section in sections)
    row = np.concatenate([_padded(section, height) for section in sections], axis=1)
    inside = row[row > 0]
    top = float(np.percentile(inside, 99.5)) if inside.size else 1.0
    file = io.BytesIO()
    imsave(file, np.clip(row / top, 0, 1), cmap="gray", vmin=0, vmax=1, format="png")
    return file.getvalue()


def _middle(data: NDArray[np.float32]) -> list[int]:
    """The voxel [3] in the middle of the positive voxels; of the grid if there are none."""
    found = np.argwhere(data > 0)
    if not len(found):
        return [n // 2 for n in data.shape]
    return [int(n) for n in (found.min(0) + found.max(0)) // 2]


def _padded(section: NDArray[np.float32], height: int) -> NDArray[np.float32]:
    """A section [rows columns] with dark rows above and below."""
    missing = height - section.shape[0]
    return np.pad(section, ((missing // 2, missing - missing // 2), (0, 0)))
