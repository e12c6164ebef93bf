"""Folders of slices for tests: an ellipsoid with a pattern, cut by stacks whose slices have individual poses."""

from __future__ import annotations

from pathlib import Path

import nibabel as nib
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

PIXEL_MM, THICKNESS_MM, SHAPE = 2.0, 3.0, (30, 34)
HALF_MM = np.array([22.0, 26.0, 18.0])

AXIAL = np.eye(3)
CORONAL = np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]]).T  # normal along y, left-handed with the x and z axes
SAGITTAL = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]).T


def poses(
    frame: NDArray[np.float64], n_slices: int, rng: np.random.Generator, *, deg: float = 3.0, mm: float = 1.0
) -> list[NDArray[np.float64]]:
    """Affines [4, 4] of parallel slices about the origin, each slightly moved.

    Args:
        frame: [3, 3] columns are the axes of the image; the third may be left-handed.
        n_slices: one thickness apart.
        rng: draws the motions.
        deg: standard deviation of rotations about each axis.
        mm: standard deviation of translations along each axis.
    """
    found = []
    for k in range(n_slices):
        affine = np.eye(4)
        affine[:3, :3] = frame * [PIXEL_MM, PIXEL_MM, THICKNESS_MM]
        middle = [(SHAPE[0] - 1) / 2, (SHAPE[1] - 1) / 2, (n_slices - 1) / 2 - k]
        affine[:3, 3] = -affine[:3, :3] @ middle
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(np.deg2rad(deg) * rng.normal(size=3)).as_matrix()
        motion[:3, 3] = mm * rng.normal(size=3)
        found.append(motion @ affine)
    return found


def seen(affine: NDArray[np.float64], shape: tuple[int, int] = SHAPE) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Image and mask [I, J] of the head at the pose of a slice."""
    index = np.stack([*np.indices(shape), np.zeros(shape), np.ones(shape)], axis=-1)
    world = index @ affine[:3].T
    inside = ((world / HALF_MM) ** 2).sum(-1) < 1
    image = 100 + 30 * np.sin(world / 5).sum(-1)
    return (image * inside).astype(np.float32), inside


def write_slice(
    folder: Path,
    name: str,
    affine: NDArray[np.float64],
    image: NDArray[np.generic] | None = None,
    mask: NDArray[np.bool_] | None = None,
) -> None:
    """Write N.nii.gz, and mask_N.nii.gz if there is a mask; without an image, the head is shown.

    Args:
        folder: made where it is not there.
        name: N, with or without an ending.
        affine: [4, 4].
        image: [I, J].
        mask: [I, J]; none is written when None.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file = name if ".nii" in name else f"{name}.nii.gz"
    image = seen(affine)[0] if image is None else image
    nib.save(nib.Nifti1Image(image[:, :, None], affine), folder / file)
    if mask is not None:
        nib.save(nib.Nifti1Image(mask[:, :, None].astype(np.uint8), affine), folder / f"mask_{file}")


def write_stack(folder: Path, affines: list[NDArray[np.float64]], first: int = 0, *, masks: bool = True) -> None:
    """Write slices with consecutive numbers, cropped to different shapes as by other programs.

    Args:
        folder: made where it is not there.
        affines: [4, 4] of each.
        first: number of the first.
        masks: whether masks are written.
    """
    for k, affine in enumerate(affines):
        image, mask = seen(affine)
        low = np.array([k % 3, k % 4])
        cropped = affine.copy()
        cropped[:3, 3] += affine[:3, :2] @ low
        image, mask = image[low[0] :, low[1] : SHAPE[1] - k % 2], mask[low[0] :, low[1] : SHAPE[1] - k % 2]
        write_slice(folder, str(first + k), cropped, image, mask if masks else None)


def write_three(folder: Path, rng: np.random.Generator, *, masks: bool = True) -> list[int]:
    """Write an axial, a coronal (left-handed) and a sagittal stack in turn; returns the number of slices of each.

    Args:
        folder: made where it is not there.
        rng: draws the motions.
        masks: whether masks are written.
    """
    counts = [11, 15, 13]
    for n, (frame, count) in enumerate(zip((AXIAL, CORONAL, SAGITTAL), counts, strict=True)):
        write_stack(folder, poses(frame, count, rng), sum(counts[:n]), masks=masks)
    return counts
