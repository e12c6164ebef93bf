"""From a stack to the mask of the fetal brain, with trained mask networks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_fill_holes, label

from g3r.acquisition.axis_resampling import along_axes, axis_weights, centred_positions_mm

if TYPE_CHECKING:
    from g3r.mask_network.model import MaskModel
    from g3r.mask_network.network import MaskNetwork

Image = NDArray[np.float32]

MIN_VOLUME_ML = 10.0
"""What is smaller is no head; at 19 weeks a brain has 20 ml, and a stack may show half of it."""
MIN_PRESENCE = 0.65
"""Mean probability of a component that is taken for a head."""
CROP_MM = 150.0
"""Smallest edge of the crop in which the brain is outlined."""
AROUND_MM = 20.0
"""In the plane on each side of what was found."""
BESIDE_MM = 14.0
"""Further slices on each side of what was found."""
JOIN_MM = 6.0
"""Parts of a mask no further from each other belong together: a head moves between slices."""
FLIPS: tuple[tuple[int, ...], ...] = ((), (2,), (3,), (2, 3))
"""Axes along which the images are mirrored for further estimates."""


@dataclass(frozen=True, kw_only=True)
class BrainMask:
    """The fetal brain in a stack.

    Args:
        mask: [I, J, K]; empty where no head was found.
        probability: [I, J, K] float32 of brain; zero outside the crop.
        presence: 0 to 1, mean probability of what was taken for the head; 0 without.
        centre_mm: [3] of the mask along the stack's axes, from the middle of its first voxel; NaN without.
        volume_ml: of the mask.
        reason: why there is none; empty where a head was found.
    """

    mask: NDArray[np.bool_]
    probability: Image
    presence: float
    centre_mm: NDArray[np.float64]
    volume_ml: float
    reason: str = ""

    @property
    def found(self) -> bool:
        """Whether a head was found."""
        return not self.reason


@dataclass(frozen=True)
class FoundHead:
    """The component of a coarse probability that is most likely a head: `inside` [A, B, C], volume and presence."""

    inside: NDArray[np.bool_]
    volume_ml: float
    presence: float

    @property
    def is_head(self) -> bool:
        """Whether it is large and certain enough."""
        return self.volume_ml >= MIN_VOLUME_ML and self.presence >= MIN_PRESENCE


def find_brain(image: NDArray[np.floating], spacing_mm: Sequence[float], model: MaskModel) -> BrainMask:
    """Find the fetal brain in a stack and outline it.

    Args:
        image: [I, J, K] stack in any units, slices along the last axis.
        spacing_mm: [3] of its voxels.
        model: trained mask networks.
    """
    image = np.asarray(image, dtype=np.float32)
    spacing = np.asarray(spacing_mm, dtype=np.float64)
    refused = _refusal(image, spacing)
    if refused:
        return _nothing(image.shape, refused)
    network = model.network
    head, at_mm = _found(network, image, spacing)
    if not head.is_head:
        return _nothing(
            image.shape,
            f"no head found: the likeliest part has {head.volume_ml:.0f} ml and a probability of {head.presence:.2f}; "
            f"expected at least {MIN_VOLUME_ML:g} ml and {MIN_PRESENCE:g}",
        )
    probability = _outlined(network, image, spacing, head.inside, at_mm)
    mask = cleaned(probability > 0.5, spacing)
    volume_ml = float(mask.sum() * spacing.prod() / 1000)
    if volume_ml < MIN_VOLUME_ML:
        return _nothing(image.shape, f"no head found: {volume_ml:.1f} ml were outlined; expected {MIN_VOLUME_ML:g}")
    return BrainMask(
        mask=mask,
        probability=probability,
        presence=head.presence,
        centre_mm=np.argwhere(mask).mean(0) * spacing,
        volume_ml=volume_ml,
    )


def likeliest_head(probability: Image, voxel_mm: float) -> FoundHead:
    """The component that holds most brain.

    Args:
        probability: [A, B, C] of brain, isotropic.
        voxel_mm: its voxel size.
    """
    parts, n = label(probability > 0.5)
    if n == 0:
        return FoundHead(np.zeros(probability.shape, dtype=bool), 0.0, 0.0)
    weight = np.bincount(parts.ravel(), probability.ravel())[1:]
    inside = parts == 1 + int(weight.argmax())
    return FoundHead(inside, float(inside.sum() * voxel_mm**3 / 1000), float(probability[inside].mean()))


def cleaned(mask: NDArray[np.bool_], spacing_mm: NDArray[np.float64]) -> NDArray[np.bool_]:
    """The largest part of a mask with its holes filled; parts that nearly touch, also in the next slice, are one.

    Args:
        mask: [I, J, K].
        spacing_mm: [3].
    """
    reach = np.maximum(np.round(JOIN_MM / 2 / spacing_mm[:2]).astype(int), 1)
    element = np.ones((2 * reach[0] + 1, 2 * reach[1] + 1, 1), dtype=bool)
    near = np.stack([np.any(mask[:, :, max(k - 1, 0) : k + 1], 2) for k in range(mask.shape[2])], 2)
    parts, n = label(binary_dilation(near, element))
    if n == 0:
        return mask
    size = np.bincount(parts[mask], minlength=n + 1)
    size[0] = 0
    kept = mask & (parts == int(size.argmax()))
    return np.stack([binary_fill_holes(kept[:, :, k]) for k in range(kept.shape[2])], axis=2)


def _refusal(image: Image, spacing: NDArray[np.float64]) -> str:
    """Why an image cannot be looked at; empty where it can."""
    if image.ndim != 3 or min(image.shape) < 1:
        return f"shape {image.shape}; expected a stack [I, J, K]"
    if spacing.shape != (3,) or not (np.isfinite(spacing).all() and (spacing > 0).all()):
        return f"spacing {spacing.tolist()} mm; expected three positive numbers"
    if not np.isfinite(image).all():
        return "the image holds NaN or infinity"
    if not image.max() > image.min():
        return f"every value of the image is {float(image.flat[0]):g}"
    return ""


def _nothing(shape: tuple[int, ...], reason: str) -> BrainMask:
    return BrainMask(
        mask=np.zeros(shape, dtype=bool),
        probability=np.zeros(shape, dtype=np.float32),
        presence=0.0,
        centre_mm=np.full(3, np.nan),
        volume_ml=0.0,
        reason=reason,
    )


def _found(
    network: MaskNetwork, image: Image, spacing: NDArray[np.float64]
) -> tuple[FoundHead, list[NDArray[np.floating]]]:
    """The likeliest head on the coarse grid, and the grid's positions along each axis (mm from the first voxel)."""
    step = network.config.coarse_mm
    at = [
        centred_positions_mm(max(1, round(n * mm / step)), step, n, mm)
        for n, mm in zip(image.shape, spacing, strict=True)
    ]
    weights = [axis_weights(n, mm, a, step) for n, mm, a in zip(image.shape, spacing, at, strict=True)]
    return likeliest_head(_probability(network.find, along_axes(image, weights)), step), at


def _outlined(
    network: MaskNetwork,
    image: Image,
    spacing: NDArray[np.float64],
    inside: NDArray[np.bool_],
    at_mm: Sequence[NDArray[np.floating]],
) -> Image:
    """Probability of brain on the stack's own grid.

    Args:
        network: both networks.
        image: [I, J, K] stack.
        spacing: [3] of it (mm).
        inside: [A, B, C] the head on the coarse grid.
        at_mm: positions of that grid along each axis.
    """
    pixel = network.config.pixel_mm
    rows = [np.flatnonzero(inside.any(axis=other)) for other in ((1, 2), (0, 2), (0, 1))]
    low = [float(at[row[0]]) for at, row in zip(at_mm, rows, strict=True)]
    high = [float(at[row[-1]]) for at, row in zip(at_mm, rows, strict=True)]
    crop = []
    for axis in (0, 1):
        edge = max(CROP_MM, high[axis] - low[axis] + 2 * AROUND_MM)
        n = int(np.ceil(edge / pixel))
        crop.append((low[axis] + high[axis]) / 2 + (np.arange(n) - (n - 1) / 2) * pixel)
    first = max(0, int(np.floor((low[2] - BESIDE_MM) / spacing[2])))
    last = min(image.shape[2], int(np.ceil((high[2] + BESIDE_MM) / spacing[2])) + 1)
    part = image[:, :, first:last]
    same = np.eye(last - first, dtype=np.float32)
    weights = [axis_weights(image.shape[a], float(spacing[a]), crop[a], pixel) for a in (0, 1)]
    found = _probability(network.outline, along_axes(part, [*weights, same]))
    # back to the stack's pixels: the crop's first pixel is the origin of its positions
    back = [
        axis_weights(len(crop[a]), pixel, np.arange(image.shape[a]) * spacing[a] - crop[a][0], float(spacing[a]))
        for a in (0, 1)
    ]
    result = np.zeros(image.shape, np.float32)
    result[:, :, first:last] = along_axes(found, [*back, same])
    return result


def _probability(logits_of: object, image: Image) -> Image:
    """Mean probability over mirrored images."""
    tensor = torch.from_numpy(np.ascontiguousarray(image))[None, None]
    total = torch.zeros_like(tensor)
    with torch.inference_mode():
        for axes in FLIPS:
            total += torch.sigmoid(logits_of(tensor.flip(axes))).flip(axes)  # type: ignore[operator]
    return (total / len(FLIPS))[0, 0].numpy()
