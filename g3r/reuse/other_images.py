"""Other images of the same slices: echoes, contrasts and label maps in the poses of a finished run."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.coarse_volume import coarse_and_density
from g3r.acquisition.images import check_grid, load_volume
from g3r.acquisition.least_squares import sharpened_volume
from g3r.acquisition.planes import Slices
from g3r.errors import InputError
from g3r.output.reuse_record import ReuseRecord
from g3r.reuse.finished_run import FinishedRun

MAX_LABEL = 32767
"""Largest label, because label maps are written as int16."""

LABEL_MARGIN_PIXELS = 3
"""Slices are cropped to their masks; label maps also vote, for background, in a margin of this size around them."""

LEAST_VOTES = 0.1
"""Density of votes below which a voxel gets no label: a tenth of that of one gapless stack."""

Pixels = NDArray[np.float32]


def load_images(run: FinishedRun, paths: Sequence[str | os.PathLike[str]]) -> list[Pixels]:
    """Images [I, J, K] on the grids of the run's stacks, slices along the third axis.

    Args:
        run: the run of the stacks that they belong to.
        paths: one per stack, in the order of the run.

    Raises:
        InputError: the numbers of images and stacks differ, or an image cannot be read or is on another grid.
    """
    if len(paths) != len(run.geometry.stacks):
        names = ", ".join(run.stack_names)
        raise InputError(f"{len(paths)} images for {len(run.stack_names)} stacks ({names}); pass one each, in order")
    images = []
    for path, stack, name in zip(paths, run.geometry.stacks, run.stack_names, strict=True):
        volume = load_volume(path)
        check_grid(volume, stack.in_file(), f"that of {name} in the run", "image")
        images.append(stack.axes.from_file(volume.data))
    return images


def slices_of(geometry: ReuseRecord, images: Sequence[Pixels], margin_pixels: int = 0) -> Slices:
    """The run's slices in their final poses, with the pixels of other images.

    Args:
        geometry: geometry of the run.
        images: [I, J, K] for each stack, slices along the third axis.
        margin_pixels: margin around the part of a slice that the run used, as far as the image reaches. With a margin
            the mask holds every pixel.
    """
    planes, slices = geometry.slices.planes, geometry.slices
    limit = np.array([geometry.stacks[s].grid.shape[:2] for s in slices.stack_id]).reshape(-1, 2)
    first = geometry.first_pixel()
    low, high = np.maximum(first - margin_pixels, 0), np.minimum(first + planes.shape + margin_pixels, limit)
    shift_mm = ((low + high) - (2 * first + planes.shape)) / 2 * planes.spacing_mm
    center = planes.center_mm + np.einsum("kij,kj->ki", planes.rotation[:, :, :2], shift_mm)
    planes = replace(planes, center_mm=center, shape=high - low)
    parts = [
        images[s][low[k, 0] : high[k, 0], low[k, 1] : high[k, 1], slices.slice_index[k]].ravel()
        for k, s in enumerate(slices.stack_id)
    ]
    value = np.concatenate([*parts, np.zeros(0, np.float32)]).astype(np.float32)
    mask = slices.mask if margin_pixels == 0 else np.ones(len(value), bool)
    return replace(slices, planes=planes, value=value, mask=mask)


def reconstruct_images(run: FinishedRun, images: Sequence[Pixels], *, with_gain: bool = True) -> Pixels:
    """The volume [I, J, K] of other images on the run's grid, by regularised least squares in the run's poses.

    V_sharp of these images, without prior and Gaussians, which have the run's contrast. Zero outside the support.

    Args:
        run: has poses, masks, PSF and slice weights.
        images: from `load_images`.
        with_gain: whether the run's gains of slices are divided out.

    Raises:
        InputError: values inside the masks are not finite, or all equal.
    """
    found = run.geometry
    slices = slices_of(found, images)
    for n, name in enumerate(run.stack_names):
        inside = slices.value[slices.mask & (slices.stack_id == n)[slices.planes.plane_id()]]
        if not np.isfinite(inside).all():
            raise InputError(f"image {n + 1} (of {name}): values inside the mask are not finite; repair the image")
        if inside.size and inside.min() == inside.max():
            raise InputError(f"image {n + 1} (of {name}): every value inside the mask is {inside[0]:g}; pass an image")
    slices = replace(slices, value=np.nan_to_num(slices.value, posinf=0, neginf=0))
    gain = found.gain if with_gain else None
    weight = found.weight[slices.pixel_plane]
    coarse, _ = coarse_and_density(slices, found.grid, gain, weight)
    return sharpened_volume(slices, found.grid, coarse, gain, weight) * found.support


def fuse_labels(run: FinishedRun, images: Sequence[Pixels]) -> NDArray[np.int16]:
    """Label maps of the stacks as one [I, J, K] on the run's grid: each voxel takes the label with most votes.

    A pixel votes for its label in the voxels that its PSF reaches, with its weight there. Background (0) has votes,
    too. Pixels outside the masks vote, as far as `LABEL_MARGIN_PIXELS` beyond the masks' bounding boxes.

    Args:
        run: has poses, PSF and slice weights.
        images: from `load_images`; whole numbers from 0.

    Raises:
        InputError: some values are not labels, or there is only background.
    """
    for n, (image, name) in enumerate(zip(images, run.stack_names, strict=True)):
        whole = np.isfinite(image).all() and (image == np.rint(image)).all()
        if not whole or image.min() < 0 or image.max() > MAX_LABEL:
            raise InputError(
                f"label map {n + 1} (of {name}): holds values that are no labels; expected whole numbers from 0 to "
                f"{MAX_LABEL}, pass a label map"
            )
    found = run.geometry
    slices = slices_of(found, images, LABEL_MARGIN_PIXELS)
    labels = np.unique(slices.value).astype(np.int16)
    if not labels.any():
        raise InputError("label maps: hold no label in the slices that the run used; pass maps with labels above 0")
    weight = found.weight[slices.pixel_plane]
    most = np.zeros(found.grid.shape, np.float32)
    fused = np.zeros(found.grid.shape, np.int16)
    for label in labels:
        votes, density = coarse_and_density(
            replace(slices, value=(slices.value == label).astype(np.float32)), found.grid, weight=weight
        )
        better = (votes > most) & (density > LEAST_VOTES)
        most[better], fused[better] = votes[better], label
    return fused
