"""From a stack to the mask of the fetal brain, with a trained mask network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.acquisition.axis_resampling import along_axes, axis_weights, centred_positions_mm
from g3r.mask_network.brightness import detail_inside, evened
from g3r.mask_network.mask_shape import (
    as_people_draw,
    cleaned,
    without_clefts,
    without_doubtful_ends,
    without_outgrowths,
)

if TYPE_CHECKING:
    from torch import Tensor

    from g3r.mask_network.model import MaskModel
    from g3r.mask_network.network import MaskNetwork

Array = NDArray[np.floating]
Image = NDArray[np.float32]

MIN_VOLUME_ML = 10.0
"""What is smaller is no head; at 19 weeks a brain has 20 ml, and a stack may show half of it."""
MIN_PRESENCE = 0.85
"""Mean probability of a mask that is taken for a brain."""
MIN_DETAIL = 0.03
"""Of `detail_inside`: smooth balls in a shell have 0.020 and 0.024, the flattest of 63 simulated heads 0.038."""
LEAST_PROBABILITY = 0.35
"""Of a pixel of the brain: a lost piece of brain is worse than a piece of what is beside it."""
N_PLACES = 3
"""Places at which a brain is outlined; the one that looks most like it from near is taken."""
PLACE_MM = 12.0
"""Standard deviation of the smoothing before the most likely places are looked for."""
APART_MM = 45.0
"""Distance of places from each other, and how far from a place slices are looked at."""
MIN_PLACE = 0.02
"""Smoothed probability below which a place is not looked at."""
CROP_MM = 150.0
"""Smallest edge of the crop in which the brain is outlined."""
AROUND_MM = 20.0
"""In the plane on each side of what was found."""
BESIDE_MM = 14.0
"""Further slices on each side of what was found."""
FLIPS: tuple[tuple[int, ...], ...] = ((), (2, 3))
"""Axes of a tensor along which the images are mirrored for further estimates."""
WIDE_FLIPS = (*FLIPS, (2,), (3,))
"""The same from afar, where few pixels cost little and a wrong place costs everything."""


@dataclass(frozen=True, kw_only=True)
class BrainMask:
    """The fetal brain in a stack.

    Args:
        mask: [I, J, K] with the rim of `as_people_draw`; empty where no head was found.
        probability: [I, J, K] float32 of brain; zero outside the crop.
        presence: 0 to 1, mean probability in the mask without its rim; 0 without.
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


def find_brain(image: NDArray[np.floating], spacing_mm: Sequence[float], model: MaskModel) -> BrainMask:
    """Find the fetal brain in a stack and outline it.

    Args:
        image: [I, J, K] stack in any units, slices along the last axis.
        spacing_mm: [3] of its voxels.
        model: trained mask network.
    """
    image = np.asarray(image, dtype=np.float32)
    spacing = np.asarray(spacing_mm, dtype=np.float64)
    refused = _refusal(image, spacing)
    if refused:
        return _nothing(image.shape, refused)
    network = model.network
    tried = _candidates(network, image, spacing)
    if not tried:
        return _nothing(image.shape, "no head found: nothing in the image looks like a brain")
    best = next((mask for mask in tried if not _is_even(image, mask, spacing)), tried[0])
    # again about what was outlined: the place was a rough one
    again, _ = _mask_in(network, image, spacing, *_ends(best, spacing))
    probability = _outlined(network, image, spacing, *_ends(again if again.any() else best, spacing), FLIPS)
    mask = without_outgrowths(cleaned(probability > LEAST_PROBABILITY, spacing), probability, spacing)
    mask = without_doubtful_ends(mask, probability)
    volume_ml = float(mask.sum() * spacing.prod() / 1000)
    presence = float(probability[mask].mean()) if mask.any() else 0.0
    if volume_ml < MIN_VOLUME_ML or presence < MIN_PRESENCE:
        return _nothing(
            image.shape,
            f"no head found: what looks most like a brain has {volume_ml:.0f} ml and a probability of {presence:.2f}; "
            f"expected at least {MIN_VOLUME_ML:g} ml and {MIN_PRESENCE:g}",
        )
    if _is_even(image, mask, spacing):
        return _nothing(image.shape, "no head found: what looks most like a brain is as even as a ball of fluid")
    drawn = as_people_draw(without_clefts(mask, spacing), spacing)
    return BrainMask(
        mask=drawn,
        probability=probability,
        presence=presence,
        centre_mm=np.argwhere(mask).mean(0) * spacing,
        volume_ml=float(drawn.sum() * spacing.prod() / 1000),
    )


def likely_places(probability: Image, spacing_mm: Array) -> list[NDArray[np.int64]]:
    """Where a brain may be: voxels [3] about which there is most probability, the likeliest first.

    Args:
        probability: [A, B, C] of brain.
        spacing_mm: [3] of its voxels.
    """
    left = gaussian_filter(probability, PLACE_MM / np.asarray(spacing_mm), mode="constant")
    position = np.indices(left.shape) * np.reshape(spacing_mm, (3, 1, 1, 1))
    places = []
    for _ in range(N_PLACES):
        place = np.array(np.unravel_index(int(left.argmax()), left.shape))
        if left[tuple(place)] < MIN_PLACE:
            break
        places.append(place)
        off = ((position - (place * spacing_mm)[:, None, None, None]) ** 2).sum(0)
        left[off < APART_MM**2] = 0
    return places


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


def _candidates(network: MaskNetwork, image: Image, spacing: Array) -> list[NDArray[np.bool_]]:
    """Masks [I, J, K] of what may be a head, the most likely one first."""
    for even in (False, True):  # where a head is dark beside something bright, only the second look shows it
        coarse, boxes = _boxes(network, image, spacing, even)
        tried = [one for low, high in boxes if (one := _mask_in(network, image, spacing, low, high))[0].any()]
        if tried:
            break
    # from near and from afar it should look like a brain: what does not from afar counts against it
    tried.sort(key=lambda one: -float((one[1] * (2 * coarse - 1))[one[0]].sum()))
    return [mask for mask, _ in tried]


def _is_even(image: Image, mask: NDArray[np.bool_], spacing: Array) -> bool:
    """Whether a mask is large enough to show folds and shows none."""
    return detail_inside(image, mask, spacing) < MIN_DETAIL  # not so where that is NaN


def _boxes(network: MaskNetwork, image: Image, spacing: Array, even: bool) -> tuple[Image, list[tuple[Array, Array]]]:
    """Probability of brain on the stack's grid from afar, and boxes where a head may be: two positions [3] (mm).

    Args:
        network: trained.
        image: [I, J, K] stack.
        spacing: [3] of it (mm).
        even: whether brightness is made even first.
    """
    step = network.config.wide_mm
    at = [
        centred_positions_mm(max(1, round(n * mm / step)), step, n, mm)
        for n, mm in zip(image.shape[:2], spacing[:2], strict=True)
    ]
    same = np.eye(image.shape[2], dtype=np.float32)
    sizes = list(zip(image.shape[:2], spacing[:2], at, strict=True))
    wide = along_axes(image, [*(axis_weights(n, mm, a, step) for n, mm, a in sizes), same])
    if even:
        wide = evened(wide, np.array([step, step, spacing[2]]))
    probability = _probability(network, wide, WIDE_FLIPS)
    back = [axis_weights(len(a), step, np.arange(n) * mm - a[0], mm) for n, mm, a in sizes]
    # the crop's size in the plane is never less than `CROP_MM`
    reach = np.array([0.0, 0.0, APART_MM])
    boxes = []
    for i, j, k in likely_places(probability, np.array([step, step, spacing[2]])):
        place = np.array([at[0][i], at[1][j], k * spacing[2]])
        boxes.append((place - reach, place + reach))
    return along_axes(probability, [*back, same]), boxes


def _ends(mask: NDArray[np.bool_], spacing: Array) -> tuple[Array, Array]:
    """Lowest and highest positions [3] of a mask (mm from the first voxel)."""
    index = np.argwhere(mask)
    return index.min(0) * spacing, index.max(0) * spacing


def _mask_in(
    network: MaskNetwork, image: Image, spacing: Array, low: Array, high: Array
) -> tuple[NDArray[np.bool_], Image]:
    """The mask outlined about a box, and the probability of brain; see `_outlined`."""
    probability = _outlined(network, image, spacing, low, high, FLIPS[:1])
    return cleaned(probability > 0.5, spacing), probability


def _outlined(
    network: MaskNetwork, image: Image, spacing: Array, low: Array, high: Array, flips: Sequence[tuple[int, ...]]
) -> Image:
    """Probability of brain on the stack's own grid, in a crop about a box.

    Args:
        network: trained.
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
    found = _probability(network, along_axes(part, [*weights, same]), flips)
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
