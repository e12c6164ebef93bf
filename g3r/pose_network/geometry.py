"""Rigid motions, groups of slices and sampling for the pose network, in torch."""

from typing import Any

import torch
from torch import Tensor

from g3r.geometry.quaternion import rotation_from_unit_quaternion

MIN_SINGULAR_SUM = 0.05
"""Least sum of two singular values in gradients. Below it they cancel, and the rotation is not determined."""


class _NearestRotation(torch.autograd.Function):
    """Polar factor of [S, 3, 3] matrices with det +1.

    The gradient is R K with K antisymmetric, from differentiating M = R P with P symmetric. It divides by
    sums of singular values only; torch's own through `svd` also divides by differences, which are often zero.
    """

    @staticmethod
    def forward(ctx: Any, matrix: Tensor) -> Tensor:
        with torch.autocast(matrix.device.type, enabled=False):
            left, singular, right = torch.linalg.svd(matrix)
            sign = torch.ones_like(singular)
            sign[:, 2] = torch.sign(torch.linalg.det(left @ right))
            rotation = (left * sign[:, None]) @ right
        ctx.save_for_backward(rotation, singular * sign, right)
        return rotation

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        rotation, singular, right = ctx.saved_tensors
        turned = right @ rotation.transpose(1, 2) @ gradients[0] @ right.transpose(1, 2)
        pairs = (singular[:, :, None] + singular[:, None]).clamp_min(MIN_SINGULAR_SUM)
        antisymmetric = (turned - turned.transpose(1, 2)) / pairs
        return rotation @ right.transpose(1, 2) @ antisymmetric @ right


def nearest_rotation(matrix: Tensor) -> Tensor:
    """The rotations nearest to matrices [S, 3, 3] in the Frobenius norm.

    A sum of rotation votes is their maximum-likelihood mean under matrix Fisher distributions, whose
    magnitudes are the votes' certainty. Source: Levinson et al., "An analysis of SVD for deep rotation
    estimation", NeurIPS 2020.
    """
    return _NearestRotation.apply(matrix)


def rotation_from_vector(vector: Tensor) -> Tensor:
    """Rotations [S, 3, 3] of vectors [S, 3]: the unit quaternion along (1, v / 2); about v rad when small."""
    quaternion = torch.nn.functional.normalize(torch.cat([torch.ones_like(vector[:, :1]), vector / 2], dim=1), dim=1)
    return rotation_from_unit_quaternion(quaternion)


def group_mean(value: Tensor, group: Tensor, n_groups: int) -> Tensor:
    """Average values by group; a group without values has mean 0.

    Args:
        value: [S, ...].
        group: [S] group of each value, 0 to G - 1.
        n_groups: G.

    Returns:
        [G, ...].
    """
    total = value.new_zeros(n_groups, *value.shape[1:]).index_add(0, group, value)
    count = torch.bincount(group, minlength=n_groups).clamp_min(1).to(value.dtype)
    return total / count.reshape(-1, *[1] * (value.dim() - 1))


def pixel_points_mm(size: int, pixel_mm: float, like: Tensor) -> Tensor:
    """Positions [N * N, 3] of the pixels of a square image in its own frame.

    Args:
        size: N, pixels per edge.
        pixel_mm: pixel size.
        like: gives dtype and device.
    """
    at = (torch.arange(size, dtype=like.dtype, device=like.device) - (size - 1) / 2) * pixel_mm
    x, y = torch.meshgrid(at, at, indexing="ij")
    return torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)


def moved_points(rotation: Tensor, translation_mm: Tensor, points_mm: Tensor) -> Tensor:
    """Apply S rigid motions to P points, in full precision under autocast too.

    Args:
        rotation: [S, 3, 3].
        translation_mm: [S, 3].
        points_mm: [P, 3], the same for all motions.

    Returns:
        [S, P, 3], in mm.
    """
    with torch.autocast(points_mm.device.type, enabled=False):
        return points_mm @ rotation.transpose(1, 2) + translation_mm[:, None]


def sample_rows(volume: Tensor, points_mm: Tensor, spacing_mm: float, offset: Tensor | int = 0) -> Tensor:
    """Trilinear samples of a volume centred on the origin, zero outside.

    Args:
        volume: [..., I, J, K, C]; leading axes are further volumes, chosen by `offset`.
        points_mm: [S, P, 3].
        spacing_mm: voxel size.
        offset: number of the volume for each of the S blocks, [S], or 0.

    Returns:
        [S, P, C].
    """
    shape = torch.tensor(volume.shape[-4:-1], device=volume.device)
    index = points_mm / spacing_mm + (shape - 1) / 2
    inside = ((index >= 0) & (index <= shape - 1)).all(-1, keepdim=True)
    low = index.floor().clamp_min(0).minimum(shape - 2)
    fraction = (index - low).clamp(0, 1)
    corner = low.long()
    n_voxels = int(shape.prod())
    first = (corner[..., 0] * shape[1] + corner[..., 1]) * shape[2] + corner[..., 2]
    if isinstance(offset, Tensor):
        first = first + offset[:, None] * n_voxels
    rows = volume.reshape(-1, volume.shape[-1])
    result = torch.zeros((), dtype=volume.dtype, device=volume.device)
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                weight = torch.ones_like(fraction[..., 0])
                for axis, upper in enumerate((i, j, k)):
                    weight = weight * (fraction[..., axis] if upper else 1 - fraction[..., axis])
                step = (i * shape[1] + j) * shape[2] + k
                corner_value = rows.index_select(0, (first + step).reshape(-1)).reshape(*first.shape, -1)
                result = result + weight[..., None] * corner_value
    return result * inside


def scattered(
    points_mm: Tensor, value: Tensor, weight: Tensor, group: Tensor, n_groups: int, shape: int, spacing_mm: float
) -> Tensor:
    """Weighted sums and weights of points in cubes of voxels centred on the origin, [G, I, J, K, 2].

    Args:
        points_mm: [S, P, 3]; each is shared among the eight voxels around it; outside points are dropped.
        value: [S, P].
        weight: [S, P]; points of zero weight are skipped.
        group: [S] volume to which each block of points is added.
        n_groups: G.
        shape: voxels per edge.
        spacing_mm: voxel size.
    """
    index = points_mm / spacing_mm + (shape - 1) / 2
    low = index.floor().long()
    inside = ((low >= 0) & (low < shape - 1)).all(-1) & (weight > 0)
    fraction = (index - low)[inside]
    corner = low[inside]
    first = ((group[:, None].expand_as(inside)[inside] * shape + corner[:, 0]) * shape + corner[:, 1]) * shape
    first = first + corner[:, 2]
    both = torch.stack([value * weight, weight], -1)[inside]
    volume = value.new_zeros(n_groups * shape**3, 2)
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                share = torch.ones_like(fraction[:, 0])
                for axis, upper in enumerate((i, j, k)):
                    share = share * (fraction[:, axis] if upper else 1 - fraction[:, axis])
                volume.index_add_(0, first + (i * shape + j) * shape + k, both * share[:, None])
    return volume.reshape(n_groups, shape, shape, shape, 2)


def smoothed(volume: Tensor) -> Tensor:
    """Volumes [A, I, J, K] blurred by 1/4, 1/2, 1/4 along each axis, zero outside."""
    for axis in (1, 2, 3):
        padded = torch.nn.functional.pad(volume, [0, 0] * (3 - axis) + [1, 1])
        n = volume.shape[axis]
        volume = sum(w * padded.narrow(axis, k, n) for k, w in enumerate((0.25, 0.5, 0.25)))  # type: ignore[assignment]
    return volume


def best_age(heads: Tensor, value: Tensor, group: Tensor, n_groups: int) -> Tensor:
    """Index [G] of the template's age that correlates best with the slices of each set.

    Args:
        heads: [S, P, A] the template's heads at the pixels.
        value: [S, P] the pixels.
        group: [S] set of each slice.
        n_groups: G.
    """
    pixel = value[..., None]
    moments = torch.stack([pixel.expand_as(heads), heads, pixel**2 * torch.ones_like(heads), heads**2, pixel * heads])
    v, h, vv, hh, vh = group_mean(moments.mean(2).permute(1, 0, 2), group, n_groups).unbind(1)
    return ((vh - v * h) / ((vv - v**2) * (hh - h**2)).clamp_min(1e-12).sqrt()).argmax(1)
