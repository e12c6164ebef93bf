"""Small images and masks with any order of axes, as arrays and as files."""

from pathlib import Path

import nibabel as nib
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from g3r.acquisition.stacks import Stack

AXES = {
    "RAS": np.eye(3),
    "LAS": np.diag([-1.0, 1, 1]),
    "LPS": np.diag([-1.0, -1, 1]),
    "LPI": -np.eye(3),
    "coronal": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "oblique": Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix(),
    "oblique left-handed": Rotation.from_rotvec([1.3, 0.5, -0.9]).as_matrix() @ np.diag([1.0, 1, -1]),
}


def affine_of(
    axes: np.ndarray, spacing: ArrayLike = (0.8, 0.9, 3.0), origin: ArrayLike = (-20.0, 31.0, 7.5)
) -> np.ndarray:
    affine = np.eye(4)
    affine[:3, :3] = axes * np.array(spacing)
    affine[:3, 3] = origin
    return affine


def arrays(seed: int = 0, shape: tuple[int, int, int] = (14, 11, 6)) -> tuple[np.ndarray, np.ndarray]:
    """Distinct values, which identify each voxel, and an irregular off-centre mask."""
    rng = np.random.default_rng(seed)
    image = (1 + rng.permutation(np.prod(shape))).reshape(shape).astype(np.float32)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1)
    mask = (((index - np.array(shape) * [0.6, 0.4, 0.45]) / (np.array(shape) * 0.45)) ** 2).sum(-1) < 1
    return image, mask


def write(path: Path, data: np.ndarray, affine: np.ndarray) -> Path:
    nib.save(nib.Nifti1Image(data, affine), path)
    return path


def stacks_of_two() -> list[Stack]:
    (image, mask), (other, other_mask) = arrays(0), arrays(1, (9, 16, 5))
    return [
        Stack(image=image, mask=mask, affine=affine_of(AXES["RAS"]), thickness_mm=3.0, name="first"),
        Stack(image=other, mask=other_mask, affine=affine_of(AXES["oblique"]), thickness_mm=2.0, name="second"),
    ]
