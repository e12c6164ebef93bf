"""From a stack to the mask of the fetal brain, with trained mask networks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_fill_holes, label

from g3r.acquisition.axis_resampling import along_axes, axis_weights, centred_positions_mm

if TYPE_CHECKING:
    from torch import Tensor

    from g3r.mask_network.model import MaskModel
    from g3r.mask_network.network import MaskNetwork

Array = NDArray[np.floating]
Image = NDArray[np.float32]

MIN_VOLUME_ML = 10.0
"""What is smaller is no head; at 19 weeks a brain has 20 ml, and a stack may show half of it."""
MIN_PRESENCE = 0.65
"""Mean probability of a mask that is taken for a brain."""
N_CANDIDATES = 3
"""Places at which a brain is outlined; the one that looks most like it from near is taken."""
MIN_CANDIDATE_ML = 4.0
CROP_MM = 150.0
"""Smallest edge of the crop in which the brain is outlined."""
AROUND_MM = 20.0
"""In the plane on each side of what was found."""
BESIDE_MM = 14.0
"""Further slices on each side of what was found."""
JOIN_MM = 6.0
"""Parts of a mask no further from each other belong together: a head moves between slices."""
FLIPS: tuple[tuple[int, ...], ...] = ((), (2,), (3,), (2, 3))
"""Axes of a tensor along which the images are mirrored for further estimates."""


@dataclass(frozen=True, kw_only=True)
class BrainMask:
    """The fetal brain in a stack.

    Args:
        mask: [I, J, K]; empty where no head was found.
        probability: [I, J, K] float32 of brain; zero outside the crop.
        presence: 0 to 1, mean probability in the mask; 0 without.
        centre_mm: [3] of the mask along the stack's axes, from the middle of its first voxel; NaN without.
        volume_ml: of the mask.
        reason: why there is none; empty where a head was found.
    """

    mask: NDArray[np.bool_]
    probability: Image
    presence: float
    centre_mm: Array
    volume_ml: float
    reason: str = ""

    @property
    def found(self) -> bool:
        """Whether a head was found."""
        return not self.reason


@dataclass(frozen=True)
class Candidate:
    """A part of a coarse probability: `inside` [A, B, C], its volume (ml) and its mean probability."""

    inside: NDArray[np.bool_]
    volume_ml: float
    presence: float

    @property
    def is_head(self) -> bool:
        """Whether it is large and certain enough for a head, as far as can be seen coarsely."""
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
    best, score = None, 0.0
    for low, high in _boxes(model.network, image, spacing):
        probability = _outlined(model.network, image, spacing, low, high, FLIPS[:1])
        mask = cleaned(probability > 0.5, spacing)
        total = float(probability[mask].sum())
        if total > score:
            best, score = mask, total
    if best is None:
        return _nothing(image.shape, "no head found: nothing in the image looks like a brain")
    # once more about what was outlined, which is more exact than what was found coarsely
    index = np.argwhere(best)
    low, high = index.min(0) * spacing, index.max(0) * spacing
    probability = _outlined(model.network, image, spacing, low, high, FLIPS)
    mask = cleaned(probability > 0.5, spacing)
    volume_ml = float(mask.sum() * spacing.prod() / 1000)
    presence = float(probability[mask].mean()) if mask.any() else 0.0
    if volume_ml < MIN_VOLUME_ML or presence < MIN_PRESENCE:
        return _nothing(
            image.shape,
            f"no head found: what looks most like a brain has {volume_ml:.0f} ml and a probability of {presence:.2f}; "
            f"expected at least {MIN_VOLUME_ML:g} ml and {MIN_PRESENCE:g}",
        )
    return BrainMask(
        mask=mask,
        probability=probability,
        presence=presence,
        centre_mm=np.argwhere(mask).mean(0) * spacing,
        volume_ml=volume_ml,
    )


def candidates(probability: Image, voxel_mm: float) -> list[Candidate]:
    """The parts of a coarse probability that may be a head, those with most brain first.

    Args:
        probability: [A, B, C] of brain, isotropic.
        voxel_mm: its voxel size.
    """
    parts, n = label(probability > 0.5)
    weight = np.bincount(parts.ravel(), probability.ravel(), minlength=n + 1)[1:]
    found = []
    for number in np.argsort(-weight, kind="stable")[:N_CANDIDATES]:
        inside = parts == 1 + int(number)
        found.append(Candidate(inside, float(inside.sum() * voxel_mm**3 / 1000), float(probability[inside].mean())))
    return found


def cleaned(mask: NDArray[np.bool_], spacing_mm: Array) -> NDArray[np.bool_]:
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


def _refusal(image: Image, spacing: Array) -> str:
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


def _boxes(network: MaskNetwork, image: Image, spacing: Array) -> list[tuple[Array, Array]]:
    """Where a head may be: lowest and highest positions [3] along the axes (mm from the first voxel)."""
    step = network.config.coarse_mm
    at = [
        centred_positions_mm(max(1, round(n * mm / step)), step, n, mm)
        for n, mm in zip(image.shape, spacing, strict=True)
    ]
    weights = [axis_weights(n, mm, a, step) for n, mm, a in zip(image.shape, spacing, at, strict=True)]
    found = []
    for one in candidates(_probability(network.find, along_axes(image, weights), FLIPS), step):
        if one.volume_ml >= MIN_CANDIDATE_ML:
            index = np.argwhere(one.inside)
            ends = np.stack([index.min(0), index.max(0)])
            box = np.stack([a[ends[:, axis]] for axis, a in enumerate(at)], axis=1)
            found.append((box[0], box[1]))
    return found


def _outlined(
    network: MaskNetwork, image: Image, spacing: Array, low: Array, high: Array, flips: Sequence[tuple[int, ...]]
) -> Image:
    """Probability of brain on the stack's own grid, in a crop about a box.

    Args:
        network: both networks.
        image: [I, J, K] stack.
        spacing: [3] of it (mm).
        low: [3] where the box begins along each axis (mm from the first voxel).
        high: [3] where it ends.
        flips: see `FLIPS`.
    """
    pixel = network.config.pixel_mm
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
    found = _probability(network.outline, along_axes(part, [*weights, same]), flips)
    # back to the stack's pixels: the crop's first pixel is the origin of its positions
    back = [
        axis_weights(len(crop[a]), pixel, np.arange(image.shape[a]) * spacing[a] - crop[a][0], float(spacing[a]))
        for a in (0, 1)
    ]
    result = np.zeros(image.shape, np.float32)
    result[:, :, first:last] = along_axes(found, [*back, same])
    return result


def _probability(logits_of: Callable[[Tensor], Tensor], image: Image, flips: Sequence[tuple[int, ...]]) -> Image:
    """Mean probability over mirrored images [I, J, K]."""
    tensor = torch.from_numpy(np.ascontiguousarray(image))[None, None]
    total = torch.zeros_like(tensor)
    with torch.inference_mode():
        for axes in flips:
            total += torch.sigmoid(logits_of(tensor.flip(axes))).flip(axes)
    return (total / len(flips))[0, 0].numpy()
