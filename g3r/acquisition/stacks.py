"""A stack of parallel slices as it comes from the scanner, checked when it is made."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.brain_mask import FoundMask, MaskSource, required_mask
from g3r.acquisition.cut_images import mask_of_content, without_residue
from g3r.acquisition.file_axes import AS_IN_FILE, FileAxes, settled
from g3r.acquisition.images import Volume, load_mask, load_volume, names_of
from g3r.acquisition.k_space_extent import filled_share
from g3r.acquisition.slice_axis import find_slice_axis
from g3r.acquisition.slice_profile import NOMINAL_FWHM_PIXELS, NOT_SAID, ProfileOrigin, SliceProfile, find_slice_profile
from g3r.acquisition.stack_checks import check_arrays, check_grid, check_intensities, check_profile, spaced
from g3r.errors import InputError
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import bounding_box

logger = logging.getLogger(__name__)

MaskOfStack = str | os.PathLike[str] | FoundMask | Callable[[Volume], FoundMask]
"""The mask of a stack: its file, a mask that was found, or a function that finds it."""

FARTHEST_MM = 500.0
"""Largest distance between the heads of two stacks by their headers; scans of one session share a frame."""


@dataclass(frozen=True, kw_only=True)
class Stack:
    """Parallel slices with one header.

    Args:
        image: [I, J, K] float32, arbitrary units; K counts the slices. What is nearly zero becomes zero
            (`without_residue`).
        mask: [I, J, K] bool, the brain.
        affine: [4, 4] float64, RAS+ mm from index; may be left-handed or oblique.
        thickness_mm: thickness of a slice; the slice spacing is in the affine and may differ.
        name: for messages.
        in_plane_fwhm_pixels: of the PSF along the first and the second axis of the image.
        origin: where the PSF comes from, for the record.
        axes: how the file's arrays became these.
        file_affine: [4, 4] of the file, before it was rounded to `affine` (`settled`); None where there is no file.
        mask_source, mask_detail: see `FoundMask`.
        level: [K] or [1] what the intensities of each slice, or of all, were multiplied by
            (`acquisition.intensity_levels`).
        remarks: doubts about its files, for the verdict.

    Raises:
        InputError: a shape that does not fit, fewer than two slices, sheared axes, an empty mask, values
            that are not finite, not positive or all the same inside the mask, a thickness outside 0.1-20 mm,
            an in-plane FWHM outside 0.1-20 pixels, a voxel size that cannot be in mm.
    """

    image: NDArray[np.float32]
    mask: NDArray[np.bool_]
    affine: NDArray[np.float64]
    thickness_mm: float
    name: str = "stack"
    in_plane_fwhm_pixels: tuple[float, float] = NOMINAL_FWHM_PIXELS
    origin: ProfileOrigin = NOT_SAID
    axes: FileAxes = AS_IN_FILE
    file_affine: NDArray[np.float64] | None = None
    mask_source: MaskSource = "file"
    mask_detail: str = ""
    level: NDArray[np.float64] = field(default_factory=lambda: np.ones(1))
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        image = np.asarray(self.image, dtype=np.float32)
        mask = np.asarray(self.mask, dtype=bool)
        affine = np.array(self.affine, dtype=np.float64)
        widths = tuple(float(width) for width in self.in_plane_fwhm_pixels)
        check_arrays(image, mask, self.name)
        image = without_residue(image)  # what was set to zero is zero from here on, also for the checks
        check_grid(image.shape, affine, self.name)
        check_profile(self.thickness_mm, widths, self.name)
        check_intensities(image, mask, self.name)
        object.__setattr__(self, "image", np.where(np.isfinite(image), image, np.float32(0)))
        object.__setattr__(self, "mask", mask)
        object.__setattr__(self, "affine", affine)
        object.__setattr__(self, "level", np.atleast_1d(np.asarray(self.level, np.float64)))
        object.__setattr__(self, "thickness_mm", float(self.thickness_mm))
        object.__setattr__(self, "in_plane_fwhm_pixels", widths)

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.image.shape))
        return f"Stack({self.name}: {shape} voxels of {spaced(self.spacing_mm)} mm, {self.thickness_mm:g} mm thick)"

    @property
    def grid(self) -> VolumeGrid:
        """The voxel grid, with the slices along the third axis."""
        return VolumeGrid(self.image.shape, self.affine)

    @property
    def header_grid(self) -> VolumeGrid:
        """The voxel grid as the file's header has it, before it was rounded (`settled`)."""
        if self.file_affine is None:
            return self.grid
        return self.axes.grid_from_file(VolumeGrid(self.mask_as_in_file.shape, self.file_affine))

    @property
    def mask_as_in_file(self) -> NDArray[np.bool_]:
        """The mask with the axes of the file's image."""
        return self.axes.to_file(self.mask)

    @property
    def affine_as_in_file(self) -> NDArray[np.float64]:
        """The affine [4, 4] that belongs to `mask_as_in_file`."""
        return self.axes.grid_to_file(self.grid).affine if self.file_affine is None else self.file_affine

    @property
    def spacing_mm(self) -> NDArray[np.float64]:
        """In-plane pixel spacing (two numbers) and the distance of neighbouring slices [3]."""
        return self.grid.spacing_mm


def load_stack(
    path: str | os.PathLike[str],
    mask: MaskOfStack = required_mask,
    thickness_mm: float | None = None,
    profile: SliceProfile | None = None,
    name: str | None = None,
) -> Stack:
    """Read a stack and its mask, and its JSON sidecar where there is one.

    The slice axis is found by `find_slice_axis`. Image, mask and affine are turned together so that it becomes the
    last axis and rows have one order (`FileAxes`). Slices keep their numbers. Zeros around an extracted brain are no
    part of a mask (`mask_of_content`). The affine is rounded; no point within 120 mm of the middle moves by more than
    0.02 mm (`settled`).

    Args:
        path: of the NIfTI image.
        mask: of the brain: a file, a mask that was found, or a function that finds it, such as `whole_image`; without
            one the image must show nothing but brain.
        thickness_mm: of the slices; without one that of the sidecar is taken, or else the slice spacing, with a
            warning, because a header does not show gaps.
        profile: of a run that is repeated, in place of the sidecar's.
        name: by which people know it; the file's when None.

    Raises:
        InputError: what `load_volume`, `load_mask`, `required_mask`, `read_sidecar` and `Stack` refuse, or a sidecar
            with another slice spacing than the image's.
    """
    volume = load_volume(path)
    volume = replace(volume, name=name or volume.name)
    if isinstance(mask, FoundMask):
        found = mask
    elif callable(mask):
        found = mask(volume)
    else:
        found = FoundMask(inside=load_mask(mask, volume), source="file")
    across = find_slice_axis(path, volume.grid.spacing_mm)
    axes = FileAxes.of(volume.grid, across.axis)
    grid = settled(axes.grid_from_file(volume.grid))
    spacing = axes.grid_to_file(grid).spacing_mm
    image, inside = without_residue(axes.from_file(volume.data)), axes.from_file(found.inside)
    filled = (filled_share(image, 0), filled_share(image, 1))
    profile = find_slice_profile(path, spacing, axes.slice_axis, thickness_mm, profile, filled)
    remarks = [*volume.remarks, *([across.remark] if across.remark else [])]
    if found.source != "whole image" and found.inside.all():
        remarks.append("its mask marks every voxel; expected the brain alone")
    pixel_mm = grid.spacing_mm[:2]  # of the slices, whichever axis of the file they are along
    if profile.thickness_mm < pixel_mm.min():
        pixels = spaced(pixel_mm)
        remarks.append(f"thickness {profile.thickness_mm:g} mm is less than the pixels' {pixels} mm; check --thickness")
    for remark in remarks:
        logger.warning("%s: %s", volume.name, remark)
    mask_shown = mask_of_content(image, inside)
    if n_zero := np.count_nonzero(inside) - np.count_nonzero(mask_shown):
        share = n_zero / np.count_nonzero(inside)
        logger.info("%s: zeros around the brain are left out of its mask (%.0f %% of it)", volume.name, 100 * share)
    return Stack(
        image=image,
        mask=mask_shown,
        affine=grid.affine,
        thickness_mm=profile.thickness_mm,
        name=volume.name,
        in_plane_fwhm_pixels=profile.in_plane_fwhm_pixels,
        origin=profile.origin,
        axes=axes,
        file_affine=volume.affine,
        mask_source=found.source,
        mask_detail=found.detail,
        remarks=tuple(remarks),
    )


def load_stacks(
    paths: Sequence[str | os.PathLike[str]],
    masks: Sequence[MaskOfStack] | None = None,
    thickness_mm: Sequence[float | None] | None = None,
    profiles: Sequence[SliceProfile | None] | None = None,
    names: Sequence[str] | None = None,
) -> list[Stack]:
    """Read the stacks of one head, see `load_stack`.

    Args:
        paths: of the NIfTI images.
        masks: one for each stack, or none.
        thickness_mm: one for each stack, or none.
        profiles: one for each stack, or none.
        names: one for each stack; those of their files, told apart by `names_of`, when None.

    Raises:
        InputError: a stack that cannot be used, the same image twice, or stacks too far apart.
        ValueError: another number of masks, thicknesses, profiles or names than of stacks.
    """
    inside = masks or [required_mask] * len(paths)
    thickness = thickness_mm or [None] * len(paths)
    known = profiles or [None] * len(paths)
    stacks: list[Stack] = []
    for path, name, mask, own_mm, profile in zip(
        paths, names or names_of(paths), inside, thickness, known, strict=True
    ):
        stack = load_stack(path, mask, own_mm, profile, name)
        for other, other_path in zip(stacks, paths, strict=False):
            if Path(path).resolve() == Path(other_path).resolve():
                raise InputError(f"{stack.name}: is given twice; pass each stack once")
            _check_pair(stack, other, stack.name, other.name)
        stacks.append(stack)
    return stacks


def check_together(stacks: Sequence[Stack]) -> None:
    """Check that stacks can be of one head; `load_stacks` has done so with files.

    Raises:
        InputError: the same image twice, which would count twice, or stacks too far apart.
    """
    told = names_of([stack.name for stack in stacks])
    for n, stack in enumerate(stacks):
        for m in range(n):
            _check_pair(stack, stacks[m], told[n], told[m])


def _check_pair(stack: Stack, other: Stack, name: str, other_name: str) -> None:
    """Raise `InputError` for one image given twice, which would count twice, and for heads too far apart."""
    # compared with the axes of the files: with another header, the rows of a copy are turned
    if np.array_equal(stack.axes.to_file(stack.image), other.axes.to_file(other.image)):
        raise InputError(f"{name}: holds the same image as {other_name}; pass each stack once, and copies not at all")
    apart_mm = float(np.linalg.norm(_middle_mm(stack) - _middle_mm(other)))
    if apart_mm > FARTHEST_MM:
        raise InputError(
            f"{name}: is {apart_mm:.0f} mm from {other_name} by its header; expected scans of one head in one "
            "session, fix the header or omit the stack"
        )


def _middle_mm(stack: Stack) -> NDArray[np.float64]:
    """World position of the middle of the mask's bounding box [3]."""
    return stack.grid.world([(axis.start + axis.stop - 1) / 2 for axis in bounding_box(stack.mask)])
