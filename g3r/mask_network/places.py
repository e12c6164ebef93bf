"""Search for places in a whole stack where a head may be, by the mask network with large pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.acquisition.axis_resampling import along_axes, axis_weights, centred_positions_mm
from g3r.mask_network.brightness import evened
from g3r.mask_network.mirrored import FLIPS, FURTHER_FLIPS, brain_probability

if TYPE_CHECKING:
    from g3r.mask_network.network import MaskNetwork

Array = NDArray[np.floating]
Image = NDArray[np.float32]

N_PLACES = 3
"""Places at which a brain is outlined; the one that looks most like a brain with small pixels is taken."""
SMOOTHING_MM = 12.0
"""Standard deviation of the smoothing before the search for the most likely places."""
APART_MM = 45.0
"""Least distance between places, and distance from a place up to which slices are outlined."""
MIN_PROBABILITY = 0.02
"""Least smoothed probability of a place."""
MIN_AGREED_PROBABILITY = 0.3
"""Smoothed probability below which flips that agree on a place may all be wrong."""
RIVAL_SHARE = 0.5
"""Places with a smaller share of the probability of the likeliest one are ignored."""


class Place(NamedTuple):
    """A place where a brain may be.

    Attributes:
        voxel: [3] index of the voxel.
        probability: smoothed probability of brain around it, 0 to 1.
    """

    voxel: NDArray[np.int64]
    probability: float


def look_from_afar(
    network: MaskNetwork, image: Image, spacing: Array, even: bool
) -> tuple[Image, list[tuple[Array, Array]]]:
    """Probability of brain on the stack's grid, and boxes where a head may be: two positions [3] (mm), likeliest first.

    If the image and the image rotated by 180 degrees disagree on the likeliest place, two further flips are evaluated:
    few pixels cost little, and a wrong place loses the brain.

    Args:
        network: trained mask network.
        image: [I, J, K] stack.
        spacing: [3] voxel size of the stack (mm).
        even: whether to even out the brightness first.
    """
    step = network.config.wide_mm
    at = [
        centred_positions_mm(max(1, round(n * mm / step)), step, n, mm)
        for n, mm in zip(image.shape[:2], spacing[:2], strict=True)
    ]
    same = np.eye(image.shape[2], dtype=np.float32)
    sizes = list(zip(image.shape[:2], spacing[:2], at, strict=True))
    wide = along_axes(image, [*(axis_weights(n, mm, a, step) for n, mm, a in sizes), same])
    wide_spacing = np.array([step, step, spacing[2]])
    if even:
        wide = evened(wide, wide_spacing)
    seen = brain_probability(network, wide, FLIPS)
    probability = np.mean(seen, axis=0)
    places = likely_places(probability, wide_spacing)
    if not is_agreed(places, seen, wide_spacing):
        probability = np.mean([*seen, *brain_probability(network, wide, FURTHER_FLIPS)], axis=0)
        places = likely_places(probability, wide_spacing)
    back = [axis_weights(len(a), step, np.arange(n) * mm - a[0], mm) for n, mm, a in sizes]
    # the crop's size in the plane is never less than `inference.CROP_MM`
    reach = np.array([0.0, 0.0, APART_MM])
    boxes = []
    for (i, j, k), _ in without_outsiders(places):
        place = np.array([at[0][i], at[1][j], k * spacing[2]])
        boxes.append((place - reach, place + reach))
    return along_axes(probability, [*back, same]), boxes


def likely_places(probability: Image, spacing_mm: Array) -> list[Place]:
    """Places with the most probability of brain around them, the likeliest first.

    Args:
        probability: [A, B, C] of brain.
        spacing_mm: [3] voxel size.
    """
    left = gaussian_filter(probability, SMOOTHING_MM / np.asarray(spacing_mm), mode="constant")
    position = np.indices(left.shape) * np.reshape(spacing_mm, (3, 1, 1, 1))
    places = []
    for _ in range(N_PLACES):
        voxel = np.array(np.unravel_index(int(left.argmax()), left.shape))
        likely = float(left[tuple(voxel)])
        if likely < MIN_PROBABILITY:
            break
        places.append(Place(voxel, likely))
        off = ((position - (voxel * spacing_mm)[:, None, None, None]) ** 2).sum(0)
        left[off < APART_MM**2] = 0
    return places


def is_agreed(places: Sequence[Place], seen: Sequence[Image], spacing_mm: Array) -> bool:
    """Whether each flip has the same likeliest place as their mean.

    Args:
        places: places from the mean of the flips.
        seen: probability [A, B, C] from each flip.
        spacing_mm: [3] voxel size.
    """
    if not places or places[0].probability < MIN_AGREED_PROBABILITY:
        return False
    for one in seen:
        own = likely_places(one, spacing_mm)
        if not own or np.linalg.norm((own[0].voxel - places[0].voxel) * spacing_mm) > SMOOTHING_MM:
            return False
    return True


def without_outsiders(places: Sequence[Place]) -> list[Place]:
    """The places with at least `RIVAL_SHARE` of the probability of the likeliest one, which comes first."""
    return [place for place in places if place.probability >= RIVAL_SHARE * places[0].probability]
