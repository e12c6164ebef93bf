"""Training samples of the mask network: a wide image of large pixels, a crop of small pixels, and their masks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torchio as tio
from monai.transforms import RandRicianNoise
from numpy.typing import NDArray

from data_synth.artefacts import slice_by_slice
from data_synth.augment import applied
from data_synth.mask_scans import Scan
from g3r.acquisition.axis_resampling import along_axes, axis_weights

Image = NDArray[np.float32]

N_OVERSAMPLED = 2
"""Oversampling per axis: a pixel of the wide image averages this many samples, like a pixel of a resampled stack."""
JITTER_MM = 6.0
"""Standard deviation of a crop's centre per axis, about the error of a found head position."""
FAR_JITTER_MM = 25.0
"""Standard deviation of the centre of some crops, so that the network cannot rely on the head being in the middle."""
ELSEWHERE_SHARE = 0.3
"""Share of crops about another place, which show no head or a head at the rim."""
BESIDE_SLICES = 7
"""Largest distance in slices of a crop's middle slice from the head, so that crops also show face and neck."""
MAX_NOISE = 0.08
WIDE_NOISE = 0.05
"""Largest standard deviations of the noise in crops and in wide images, whose pixels average several samples."""
IN_PLANE_BLUR = (0, 0.9, 0, 0.9, 0, 0)
"""Range of the blur's standard deviation in pixels: from, to, for each axis."""
MOTION_SHARE = 0.05
"""Share of stacks with motion during the acquisition of slices, drawn independently for each slice."""
WRAP_SHARE = 0.08


@dataclass(frozen=True, kw_only=True)
class MaskSample:
    """Images of one scan with the share of brain in each pixel.

    Args:
        wide_image: [A, B, K] K slices of the scan in large pixels.
        wide_mask: [A, B, K].
        image: [H, W, K] slices about the head in small pixels.
        mask: [H, W, K].
    """

    wide_image: Image
    wide_mask: Image
    image: Image
    mask: Image


def draw_sample(
    scan: Scan,
    rng: np.random.Generator,
    *,
    wide_mm: float,
    wide_shape: tuple[int, int, int],
    pixel_mm: float,
    crop_shape: tuple[int, int, int],
) -> MaskSample:
    """A sample of a scan.

    Args:
        scan: of a scene.
        rng: source of randomness.
        wide_mm: pixel size of the wide image.
        wide_shape: pixels and slices of the wide image; a larger scan gives a random part.
        pixel_mm: pixel size of the crop.
        crop_shape: pixels and slices of the crop.
    """
    wide_image, wide_mask = _wide(scan, rng, wide_mm, wide_shape)
    image, mask = _crop(scan, rng, pixel_mm, crop_shape)
    return MaskSample(
        wide_image=with_artefacts(wide_image, rng, WRAP_SHARE, WIDE_NOISE),
        wide_mask=wide_mask,
        image=with_artefacts(image, rng),
        mask=mask,
    )


def _wide(scan: Scan, rng: np.random.Generator, pixel_mm: float, shape: tuple[int, int, int]) -> tuple[Image, Image]:
    small = pixel_mm / N_OVERSAMPLED
    size = np.array(shape[:2])
    room = np.maximum(scan.fov_mm - size * pixel_mm, 0) / 2
    first = rng.uniform(-1, 1, 2) * room - (size * N_OVERSAMPLED - 1) / 2 * small
    n_slices = len(scan.depth_mm)
    first_slice = int(rng.integers(max(n_slices - shape[2], 0) + 1))
    chosen = slice(first_slice, first_slice + shape[2])
    n = size * N_OVERSAMPLED
    both = scan.images((float(first[0]), float(first[1])), small, (int(n[0]), int(n[1])), chosen, n_through=2)
    n_chosen = both[0].shape[2]
    middle = (N_OVERSAMPLED - 1) / 2 * small
    weights = [
        axis_weights(int(m), small, np.arange(k) * pixel_mm + middle, pixel_mm) for m, k in zip(n, size, strict=True)
    ]
    weights.append(np.eye(n_chosen, dtype=np.float32))
    image, mask = (np.pad(along_axes(one, weights), [(0, 0), (0, 0), (0, shape[2] - n_chosen)]) for one in both)
    return image, mask


def _crop(scan: Scan, rng: np.random.Generator, pixel_mm: float, shape: tuple[int, int, int]) -> tuple[Image, Image]:
    n_slices = len(scan.depth_mm)
    if scan.with_head:
        _, look = scan.images(
            (-scan.fov_mm[0] / 2, -scan.fov_mm[1] / 2), 5.0, (int(scan.fov_mm[0] / 5), int(scan.fov_mm[1] / 5))
        )
        area = look.sum((0, 1))
        weight = look.sum(2)
        total = max(float(weight.sum()), 1e-6)
        at = [np.arange(size) * 5.0 - scan.fov_mm[axis] / 2 for axis, size in enumerate(weight.shape)]
        centre = np.array([float(weight.sum(1) @ at[0]), float(weight.sum(0) @ at[1])]) / total
        shown = np.flatnonzero(area > 1)
        low, high = (int(shown[0]), int(shown[-1])) if len(shown) else (0, n_slices - 1)
        middle = int(rng.integers(low - BESIDE_SLICES, high + BESIDE_SLICES + 1))
        if rng.random() < ELSEWHERE_SHARE:
            aside = scan.below_head_mm(float(rng.uniform(0.8, 1.6))) if rng.random() < 0.4 else scan.trunk_mm()
            if rng.random() < 0.4:
                aside = np.append(centre, 0) + rng.uniform(-90, 90, 3)
            centre, middle = aside[:2], int(np.abs(scan.depth_mm - aside[2]).argmin())
        centre = centre + rng.normal(0, JITTER_MM if rng.random() < 0.7 else FAR_JITTER_MM, 2)
    else:
        middle = int(rng.integers(n_slices))
        centre = rng.uniform(-0.4, 0.4, 2) * scan.fov_mm
    first_slice = int(np.clip(middle - shape[2] // 2, 0, max(n_slices - shape[2], 0)))
    first = centre - (np.array(shape[:2]) - 1) / 2 * pixel_mm
    chosen = slice(first_slice, first_slice + shape[2])
    image, mask = scan.images((float(first[0]), float(first[1])), pixel_mm, (shape[0], shape[1]), chosen)
    missing = [(0, 0), (0, 0), (0, shape[2] - image.shape[2])]
    return np.pad(image, missing), np.pad(mask, missing)


def _transform() -> tio.Compose:
    return tio.Compose(
        [
            tio.RandomBiasField(coefficients=0.3, order=2, p=0.7),
            tio.RandomGhosting(num_ghosts=(2, 6), axes=(0, 1), intensity=(0.1, 0.6), p=0.1),
            tio.Lambda(slice_by_slice(tio.RandomMotion(degrees=4, translation=3, num_transforms=2)), p=MOTION_SHARE),
            tio.RandomBlur(std=IN_PLANE_BLUR, p=0.4),  # type: ignore[arg-type]  # six numbers are ranges per axis
        ]
    )


def with_artefacts(
    image: Image, rng: np.random.Generator, wrap_share: float = 0.0, max_noise: float = MAX_NOISE
) -> Image:
    """A stack with random bias field, ghosts, motion, blur and gamma (torchio), and Rician noise (MONAI).

    Args:
        image: [I, J, K], with the brightest brain intensities about 1.
        rng: source of randomness.
        wrap_share: probability that signal from outside the field of view is folded in.
        max_noise: largest standard deviation of the noise.
    """
    if wrap_share and rng.random() < wrap_share:
        axis = int(rng.integers(2))
        image = image + np.float32(rng.uniform(0.2, 0.8)) * np.roll(image, image.shape[axis] // 2, axis)
    tensor = torch.from_numpy(np.ascontiguousarray(image))[None]
    result = applied(_transform(), tio.Subject(image=tio.ScalarImage(tensor=tensor)), rng)["image"].data[0].numpy()
    result = np.abs(result) ** np.float32(np.exp(rng.uniform(-0.3, 0.3)))
    noise = RandRicianNoise(prob=1.0, std=max_noise)
    noise.set_random_state(int(rng.integers(2**32)))
    return np.asarray(noise(result), dtype=np.float32)


def full_stack(scan: Scan, pixel_mm: float, rng: np.random.Generator) -> tuple[Image, NDArray[np.bool_]]:
    """A scan as a scanner would write it, with artefacts, and the true mask: pixels that are more than half brain.

    Args:
        scan: of a scene.
        pixel_mm: edge of the pixels in plane; the slice spacing is the scan's.
        rng: source of randomness.

    Returns:
        Image and mask, each [I, J, K].
    """
    shape = tuple(int(mm / pixel_mm) for mm in scan.fov_mm)
    first = -(np.array(shape) - 1) / 2 * pixel_mm
    image, inside = scan.images((float(first[0]), float(first[1])), pixel_mm, (shape[0], shape[1]))
    return with_artefacts(image, rng, WRAP_SHARE), inside > 0.5
