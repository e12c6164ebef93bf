"""A head-sized scene of any number of Gaussians, seen by three stacks, to time the renderer on."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes, Slices
from g3r.acquisition.psf import psf_variance_mm2
from g3r.gaussians import GaussianCloud
from g3r.gaussians.kernels import PAIR, set_up_plane

HEAD_MM = np.array([40.0, 48.0, 38.0])
"""Semi-axes of the ellipsoid that is full of Gaussians."""

PIXEL_MM, THICKNESS_MM = 0.8, 2.2
SIGMA_PER_SPACING, SPREAD = 0.6, 0.25
"""Of a Gaussian over the edge of its share of the head, as the fit seeds them; deviation of ln sigma."""


@dataclass(frozen=True)
class KernelScene:
    """A cloud and three stacks of slices of it, each cropped to the head and slightly tilted."""

    cloud: GaussianCloud
    slices: Slices


def head_scene(n_gaussians: int, n_slices: int | None = None, seed: int = 0) -> KernelScene:
    """Random Gaussians that fill an ellipsoid, and slices of noise (their values do not matter here).

    Args:
        n_gaussians: in the head; their size follows.
        n_slices: of each stack; None covers the head.
        seed: of everything random.
    """
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n_gaussians, 3))
    points *= (rng.random(n_gaussians) ** (1 / 3) / np.linalg.norm(points, axis=1))[:, None]
    points = (points * HEAD_MM)[np.lexsort(np.rint(points * HEAD_MM / 4).T)]  # neighbours near in memory
    spacing_mm = float(4 / 3 * np.pi * HEAD_MM.prod() / n_gaussians) ** (1 / 3)
    arrays = (
        points,
        np.log(SIGMA_PER_SPACING * spacing_mm) + rng.normal(0, SPREAD, (n_gaussians, 3)),
        rng.normal(size=(n_gaussians, 4)),
        rng.uniform(0, 1, n_gaussians),
    )
    cloud = GaussianCloud.of([torch.tensor(array, dtype=torch.float32) for array in arrays], np.zeros(3))
    frames = [
        np.eye(3),
        Rotation.from_euler("x", 90, degrees=True).as_matrix(),
        Rotation.from_euler("y", 90, degrees=True).as_matrix(),
    ]
    rotation, center, shape, stack = [], [], [], []
    for number, frame in enumerate(frames):
        reach = np.abs(frame.T) @ HEAD_MM
        n = n_slices or int(2 * reach[2] / THICKNESS_MM)
        for i in range(n):
            offset = (i - (n - 1) / 2) * THICKNESS_MM
            width = np.sqrt(max(1 - (offset / reach[2]) ** 2, 0.02))
            rotation.append(frame @ Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix())
            center.append(frame[:, 2] * offset)
            shape.append(np.maximum(2, 2 * reach[:2] * width / PIXEL_MM))
            stack.append(number)
    k = len(stack)
    spacing = np.full((k, 2), PIXEL_MM)
    planes = Planes(
        rotation=np.array(rotation),
        center_mm=np.array(center),
        spacing_mm=spacing,
        shape=np.array(shape, dtype=np.int64),
        psf_var_mm2=psf_variance_mm2(spacing, np.full(k, THICKNESS_MM)),
    )
    value = rng.random(planes.n_pixels, dtype=np.float32)
    index = np.arange(k)
    slices = Slices(
        planes=planes,
        value=value,
        mask=np.ones(len(value), bool),
        stack_id=np.array(stack),
        slice_index=index,
        thickness_mm=np.full(k, THICKNESS_MM),
        header_pose=planes.pose,
    )
    return KernelScene(cloud, slices)


@numba.njit(cache=True)
def count_pixels(shapes, rotation, center, gain, psf, shape, spacing, offset, start, order, cut, projections):
    """Number of (pair, pixel) evaluations inside the cut-off, and of pairs that have any."""
    n_pixels, n_pairs = 0, 0
    for k in range(len(rotation)):
        n = set_up_plane(
            shapes,
            order,
            start[k],
            start[k + 1],
            rotation[k],
            center[k],
            psf[k],
            shape[k],
            spacing[k],
            gain[k],
            cut,
            True,
            projections,
        )
        n_pairs += n
        for i in range(n):
            r = projections[i]
            for x in range(max(0, int(r.row - r.half_x)), min(shape[k, 0], int(r.row + r.half_x) + 3)):
                dx = x - r.row - r.x
                for y in range(max(0, int(r.column - r.half_y)), min(shape[k, 1], int(r.column + r.half_y) + 3)):
                    u = y - r.column - r.y - r.slope * dx
                    n_pixels += r.e_0 + r.q_x * dx * dx + r.q_u * u * u >= -0.5 * cut
    return n_pixels, n_pairs


def record_space(n: int) -> NDArray[np.void]:
    """Scratch space for the records of a plane with `n` pairs."""
    return np.zeros(n, PAIR)
