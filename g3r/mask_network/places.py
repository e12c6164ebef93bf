"""Where in a whole stack a head may be: the mask network's look from afar."""

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
"""Places at which a brain is outlined; the one that looks most like it from near is taken."""
SMOOTHING_MM = 12.0
"""Standard deviation of the smoothing before the most likely places are looked for."""
APART_MM = 45.0
"""Distance of places from each other, and how far from a place slices are looked at."""
MIN_PROBABILITY = 0.02
"""Smoothed, below which a place is not looked at."""
MIN_AGREED_PROBABILITY = 0.3
"""Smoothed, below which mirror images that agree on a place may be wrong alike."""
RIVAL_SHARE = 0.5
"""A place with less of the probability of the likeliest one is not looked at."""


class Place(NamedTuple):
    """Where a brain may be.

    Attributes:
        voxel: [3] numbers of the voxel.
        probability: 0 to 1, smoothed, of brain about it.
    """

    voxel: NDArray[np.int64]
    probability: float


def look_from_afar(
    network: MaskNetwork, image: Image, spacing: Array, even: bool
) -> tuple[Image, list[tuple[Array, Array]]]:
    """Probability of brain on the stack's grid, and boxes where a head may be: two positions [3] (mm), likeliest first.

    Where the image and the image turned do not agree on the likeliest place, two further mirror images are looked at,
    too: few pixels cost little, and a wrong place costs everything.

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
    """Where a brain may be, about which there is most probability, the likeliest place first.

    Args:
        probability: [A, B, C] of brain.
        spacing_mm: [3] of its voxels.
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
    """Whether the likeliest place is the likeliest one of each mirror image, too.

    Args:
        places: from the mean of the mirror images.
        seen: probability of each mirror image [A, B, C].
        spacing_mm: [3] of their voxels.
    """
    if not places or places[0].probability < MIN_AGREED_PROBABILITY:
        return False
    for one in seen:
        own = likely_places(one, spacing_mm)
        if not own or np.linalg.norm((own[0].voxel - places[0].voxel) * spacing_mm) > SMOOTHING_MM:
            return False
    return True


def without_outsiders(places: Sequence[Place]) -> list[Place]:
    """The places that have at least a share of the probability of the likeliest one, which comes first."""
    return [place for place in places if place.probability >= RIVAL_SHARE * places[0].probability]
