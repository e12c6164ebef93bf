"""Rotation matrices from quaternions, in torch and differentiable."""

from __future__ import annotations

from typing import TYPE_CHECKING

from g3r.run.on_demand import torch

if TYPE_CHECKING:
    from torch import Tensor


def rotation_from_quaternion(quaternion_wxyz: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4] of any length but zero."""
    # scaled by the largest entry first: squares of 1e-30 are zero in float32, and no epsilon fits every length
    largest = quaternion_wxyz.detach().abs().amax(1, keepdim=True)
    scaled = quaternion_wxyz / largest
    return rotation_from_unit_quaternion(scaled / scaled.norm(dim=1, keepdim=True))


def rotation_from_unit_quaternion(quaternion_wxyz: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4] of length 1."""
    w, x, y, z = quaternion_wxyz.unbind(1)
    entries = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(entries, 1).reshape(-1, 3, 3)
