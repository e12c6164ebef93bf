"""The mask of the fetal brain in a stack, from a trained mask network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.axis_resampling import along_axes, axis_weights
from g3r.mask_network.brightness import detail_inside
from g3r.mask_network.mask_shape import (
    as_people_draw,
    cleaned,
    without_clefts,
    without_doubtful_ends,
    without_outgrowths,
)
from g3r.mask_network.mirrored import FLIPS, Flip, brain_probability
from g3r.mask_network.places import look_from_afar

if TYPE_CHECKING:
    from g3r.mask_network.model import MaskModel
    from g3r.mask_network.network import MaskNetwork

Array = NDArray[np.floating]
Image = NDArray[np.float32]

MIN_VOLUME_ML = 10.0
"""Least volume of a head: at 19 weeks a brain has 20 ml, and a stack may show half of it."""
MIN_PRESENCE = 0.85
"""Least mean probability of a mask that counts as a brain."""
MIN_DETAIL = 0.03
"""Least `detail_inside` of a head: smooth balls in a shell have 0.020 and 0.024, the flattest of 63 simulated heads
0.038."""
LEAST_PROBABILITY = 0.35
"""Least probability of a brain pixel: losing a piece of brain is worse than including a piece beside it."""
CROP_MM = 150.0
"""Smallest edge of the crop in which the brain is outlined."""
AROUND_MM = 20.0
"""In-plane margin of the crop on each side of the found mask."""
BESIDE_MM = 14.0
"""Margin across slices on each side of the found mask."""


@dataclass(frozen=True, kw_only=True)
class BrainMask:
    """The fetal brain in a stack.

    Args:
        mask: [I, J, K] with the rim of `as_people_draw`; empty if no head was found.
        probability: [I, J, K] float32 of brain; zero outside the crop.
        presence: mean probability in the mask without its rim, 0 to 1; 0 if no head was found.
        centre_mm: [3] centre of the mask along the stack's axes, from its first voxel's middle; NaN if there is none.
        volume_ml: volume of the mask.
        reason: why no head was found; empty if one was.
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
        spacing_mm: [3] voxel size.
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
    # again around the outlined mask, because the first place was rough
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


def _refusal(image: Image, spacing: Array) -> str:
    """Why an image cannot be processed; empty if it can."""
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
    """Candidate masks [I, J, K] of a head, the most likely one first."""
    for even in (False, True):  # a head that is dark beside something bright shows only with even brightness
        coarse, boxes = look_from_afar(network, image, spacing, even)
        tried = [one for low, high in boxes if (one := _mask_in(network, image, spacing, low, high))[0].any()]
        if tried:
            break
    # a brain is likely at both pixel sizes: pixels that are unlikely at the large size count against a candidate
    tried.sort(key=lambda one: -float((one[1] * (2 * coarse - 1))[one[0]].sum()))
    return [mask for mask, _ in tried]


def _is_even(image: Image, mask: NDArray[np.bool_], spacing: Array) -> bool:
    """Whether a mask is large enough to show folds but shows none."""
    return detail_inside(image, mask, spacing) < MIN_DETAIL  # False for NaN


def _ends(mask: NDArray[np.bool_], spacing: Array) -> tuple[Array, Array]:
    """Lowest and highest positions [3] of a mask (mm from the first voxel)."""
    index = np.argwhere(mask)
    return index.min(0) * spacing, index.max(0) * spacing


def _mask_in(
    network: MaskNetwork, image: Image, spacing: Array, low: Array, high: Array
) -> tuple[NDArray[np.bool_], Image]:
    """The mask outlined around a box, and the probability of brain; see `_outlined`."""
    probability = _outlined(network, image, spacing, low, high, FLIPS[:1])
    return cleaned(probability > 0.5, spacing), probability


def _outlined(
    network: MaskNetwork, image: Image, spacing: Array, low: Array, high: Array, flips: Sequence[Flip]
) -> Image:
    """Probability of brain on the stack's own grid, in a crop around a box.

    Args:
        network: trained mask network.
        image: [I, J, K] stack.
        spacing: [3] voxel size of the stack (mm).
        low: [3] where the box begins along each axis (mm from the first voxel).
        high: [3] where it ends.
        flips: flips of the image over which the probability is averaged.
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
    found = np.mean(brain_probability(network, along_axes(part, [*weights, same]), flips), axis=0)
    # back to the stack's pixels: the crop's first pixel is the origin of its positions
    back = [
        axis_weights(len(crop[a]), pixel, np.arange(image.shape[a]) * spacing[a] - crop[a][0], float(spacing[a]))
        for a in (0, 1)
    ]
    result = np.zeros(image.shape, np.float32)
    result[:, :, first:last] = along_axes(found, [*back, same])
    return result
