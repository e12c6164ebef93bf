"""Made-up clouds and slices of any size, so that one size can grow while all else stays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from g3r.acquisition.planes import Planes, Slices, volume_planes
from g3r.acquisition.psf import psf_variance_mm2
from g3r.gaussians import GaussianCloud, render
from g3r.gaussians.cloud import rotation_from_quaternion
from g3r.gaussians.overlap import OverlapList
from g3r.geometry import VolumeGrid

HEAD_MM = 50.0
"""Edge of the cube that Gaussians, slices and voxels share."""

SIGMA_MM = 1.2
THICKNESS_MM = 2.5
PIXEL_MM = 0.8
"""In-plane width of the PSF, whatever the spacing of the pixels: finer ones shall not mean another scene."""

N_STACKS = 3


@dataclass(frozen=True)
class SceneSize:
    """How much there is of everything.

    Args:
        n_gaussians: of the same size in the same head, ever more on top of each other: each touches as many
            planes and pixels as before.
        n_slices: through the same head, in three stacks, ever closer.
        n_pixels: per slice, ever finer over the same area.
        n_voxels: of the volume, ever finer over the same head.
    """

    n_gaussians: int = 8000
    n_slices: int = 48
    n_pixels: int = 4096
    n_voxels: int = 125_000


def made_cloud(size: SceneSize, seed: int = 0) -> GaussianCloud:
    """Gaussians at random in the head, their axes 0.8 to 1.25 times the common sigma."""
    rng = np.random.default_rng(seed)
    n = size.n_gaussians
    return GaussianCloud.of(
        [
            torch.from_numpy(array.astype(np.float32))
            for array in (
                rng.uniform(-HEAD_MM / 2, HEAD_MM / 2, (n, 3)),
                np.log(SIGMA_MM) + rng.uniform(np.log(0.8), np.log(1.25), (n, 3)),
                rng.standard_normal((n, 4)),
                rng.uniform(0.5, 1.0, n) * (8000 / n),
            )
        ],
        np.zeros(3),
    )


def made_slices(size: SceneSize, cloud: GaussianCloud, seed: int = 1) -> Slices:
    """Slices of a cloud in three orthogonal stacks, with noise."""
    rng = np.random.default_rng(seed)
    frames = [np.eye(3)[:, order] for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1])]
    per_stack = [len(part) for part in np.array_split(np.arange(size.n_slices), N_STACKS)]
    rotation, center = [], []
    for frame, n in zip(frames, per_stack, strict=True):
        offsets = (np.arange(n) + 0.5) / max(n, 1) * HEAD_MM - HEAD_MM / 2
        rotation += [frame] * n
        center += [frame[:, 2] * offset for offset in offsets]
    side = max(2, round(size.n_pixels**0.5))
    variance = psf_variance_mm2(np.full(2, PIXEL_MM), THICKNESS_MM)
    planes = Planes(
        rotation=np.array(rotation),
        center_mm=np.array(center),
        spacing_mm=np.full((size.n_slices, 2), HEAD_MM / side),
        shape=np.full((size.n_slices, 2), side),
        psf_var_mm2=np.tile(variance, (size.n_slices, 1)),
    )
    value = render(cloud, planes).numpy()
    value = value + 0.02 * rng.standard_normal(len(value)).astype(np.float32) * value.mean()
    index = np.concatenate([np.arange(n) for n in per_stack])
    stack_id = np.repeat(np.arange(N_STACKS), per_stack)
    return Slices(
        planes=planes,
        value=value.astype(np.float32),
        mask=np.ones(len(value), bool),
        stack_id=stack_id,
        slice_index=index,
        thickness_mm=np.full(size.n_slices, THICKNESS_MM),
        header_pose=planes.pose,
    )


def corners(planes: Planes) -> Planes:
    """The same rectangles with a pixel in each corner only: the same pairs, and hardly a pixel in them."""
    return replace(planes, shape=np.full((len(planes), 2), 2), spacing_mm=(planes.shape - 1) * planes.spacing_mm)


def corner_slices(slices: Slices) -> Slices:
    """Slices with four pixels each; see `corners`."""
    n = 4 * len(slices)
    return replace(slices, planes=corners(slices.planes), value=np.ones(n, np.float32), mask=np.ones(n, bool))


def made_volume_planes(size: SceneSize) -> Planes:
    """The planes of a volume of the head."""
    side = max(2, round(size.n_voxels ** (1 / 3)))
    spacing = HEAD_MM / side
    affine = np.diag([spacing, spacing, spacing, 1.0])
    affine[:3, 3] = -spacing * (side - 1) / 2
    return volume_planes(VolumeGrid((side, side, side), affine))


def pixel_evaluations(cloud: GaussianCloud, planes: Planes, pairs: OverlapList, cutoff_sigma: float) -> float:
    """How many pixels the ellipses of all pairs cover, planes taken as endless: the work inside of pairs."""
    rotation = rotation_from_quaternion(cloud.quaternion_wxyz).double().numpy()
    root = rotation * np.exp(cloud.log_scale.double().numpy())[:, None, :]
    mean = cloud.mean_mm.double().numpy() + cloud.origin_mm
    total = 0.0
    for k in range(len(planes)):
        chosen = pairs.gaussian[pairs.start[k] : pairs.start[k + 1]]
        local = planes.rotation[k].T @ root[chosen]
        observed = local @ local.transpose(0, 2, 1) + np.diag(planes.psf_var_mm2[k])
        height = (mean[chosen] - planes.center_mm[k]) @ planes.rotation[k][:, 2]
        left = np.maximum(cutoff_sigma**2 - height**2 / observed[:, 2, 2], 0)
        in_plane = np.sqrt(np.linalg.det(observed) / observed[:, 2, 2])
        total += float((np.pi * left * in_plane).sum() / planes.spacing_mm[k].prod())
    return total
