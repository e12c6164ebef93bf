"""Cutting stacks into slices, cropped to the masks and normalised; slice spacing by the headers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.cut_images import field_of_view
from g3r.acquisition.file_axes import between
from g3r.acquisition.planes import FieldsOfView, Planes, Slices
from g3r.acquisition.psf import psf_variance_mm2
from g3r.acquisition.stacks import Stack
from g3r.errors import InputError
from g3r.geometry import RigidPose
from g3r.geometry.grid import bounding_box
from g3r.geometry.rigid import orthonormal

HALF_A_PIXEL = np.array([-0.5, 0.5])

MIN_SLICE_PIXELS = 12
"""Fewest masked pixels of a slice. Slices with fewer determine no pose and show little; they are skipped and named in
run.json. Slices without a positive masked pixel are skipped, too: they were not acquired, or were blanked."""


@dataclass(frozen=True, kw_only=True)
class _SliceRow:
    """What `Slices` hold of one slice; see `Slices`, `Planes` and `FieldsOfView`."""

    rotation: NDArray[np.float64]
    center_mm: NDArray[np.float64]
    spacing_mm: NDArray[np.float64]
    shape: tuple[int, ...]
    psf_var_mm2: NDArray[np.float64]
    value: NDArray[np.float32]
    mask: NDArray[np.bool_]
    stack_id: int
    slice_index: int
    thickness_mm: float
    extent_mm: NDArray[np.float64]
    step_mm: float
    n_beyond: tuple[int, int]


def slices_from_stacks(stacks: Sequence[Stack]) -> Slices:
    """Cut stacks into slices, each cropped to the bounding box of its mask.

    Slices whose mask has fewer than `MIN_SLICE_PIXELS` pixels, or that are blank inside it, are skipped. Zeros
    that pad a field of view were not acquired (`acquisition.cut_images`).

    Raises:
        InputError: no stack, or none with a usable slice.
    """
    if not stacks:
        raise InputError("no stack given; pass at least one")
    rows = [row for number, stack in enumerate(stacks) for row in _rows_of(stack, number)]
    if not rows:
        raise InputError(f"{stacks[0].name}: no slice with {MIN_SLICE_PIXELS} masked pixels; check the masks")

    def column(name: str) -> NDArray[Any]:
        return np.array([getattr(row, name) for row in rows])

    geometry = ("rotation", "center_mm", "spacing_mm", "shape", "psf_var_mm2")
    planes = Planes(**{name: column(name) for name in geometry})
    return Slices(
        planes=planes,
        value=np.concatenate([row.value for row in rows]).astype(np.float32),
        mask=np.concatenate([row.mask for row in rows]),
        stack_id=column("stack_id"),
        slice_index=column("slice_index"),
        thickness_mm=column("thickness_mm"),
        header_pose=planes.pose,
        view=FieldsOfView(
            extent_mm=column("extent_mm"), spacing_mm=column("step_mm"), n_beyond=column("n_beyond").astype(np.int64)
        ),
    )


def _rows_of(stack: Stack, number: int) -> Iterator[_SliceRow]:
    """The usable slices of a stack.

    Args:
        stack: with images and masks.
        number: of the stack.
    """
    # the header's third axis may be left-handed; the normal's sign does not matter to a symmetric PSF
    frame = orthonormal(stack.grid.plane_frame[None])[0]
    acquired = np.array(field_of_view(stack.image))
    used = np.flatnonzero((stack.mask.sum((0, 1)) >= MIN_SLICE_PIXELS) & ~_blank(stack)).tolist()
    before, after = _slices_beyond(stack, used)
    for k in used:
        inside = stack.mask[:, :, k]
        box = bounding_box(inside)
        middle = [(axis.start + axis.stop - 1) / 2 for axis in box]
        whole = acquired + HALF_A_PIXEL - np.array(middle)[:, None]
        yield _SliceRow(
            rotation=frame,
            center_mm=stack.grid.world([*middle, k]),
            spacing_mm=stack.spacing_mm[:2],
            shape=inside[box].shape,
            psf_var_mm2=psf_variance_mm2(stack.spacing_mm[:2], stack.thickness_mm, stack.in_plane_fwhm_pixels),
            value=stack.image[:, :, k][box].ravel(),
            mask=inside[box].ravel(),
            stack_id=number,
            slice_index=k,
            thickness_mm=stack.thickness_mm,
            extent_mm=whole * stack.spacing_mm[:2, None],
            step_mm=float(stack.spacing_mm[2] * np.sign(frame[:, 2] @ stack.grid.axes[:, 2])),
            n_beyond=(before if k == used[0] else 0, after if k == used[-1] else 0),
        )


def _blank(stack: Stack) -> NDArray[np.bool_]:
    """Which slices [K] have no positive value inside the mask."""
    return np.asarray(~((stack.image > 0) & stack.mask).any((0, 1)))


def _slices_beyond(stack: Stack, used: Sequence[int]) -> tuple[int, int]:
    """Number of consecutive slices with signal before the first and after the last used one."""
    if not used:
        return 0, 0
    # a slice of one value was not acquired, or was blanked
    dark = stack.image.min((0, 1)) == stack.image.max((0, 1))
    before, after = dark[: used[0]][::-1], dark[used[-1] + 1 :]
    counts = [int(np.argmax(side)) if side.any() else len(side) for side in (before, after)]
    return counts[0], counts[1]


def normalised_slices(stacks: Sequence[Stack]) -> tuple[Slices, float]:
    """Slices at their header poses with the 99th percentile of the masked values at 1.

    Returns:
        The slices, and the intensity that they were divided by.

    Raises:
        InputError: stacks that cannot be used, or intensities that are not positive.
    """
    slices = slices_from_stacks(stacks)
    scale = float(np.percentile(slices.masked_value, 99))
    if not scale > 0:
        raise InputError(f"99th percentile inside the masks is {scale:g}; expected a positive intensity")
    return slices.scaled(1 / scale), scale


def by_headers(slices: Slices, stacks: Sequence[Stack]) -> Slices:
    """The slices at the header poses of their files, to the last digit; the poses of stacks are rounded (`settled`).

    Args:
        slices: of the stacks.
        stacks: all of them.
    """
    header_from_stack = RigidPose.concatenated([between(stack.grid, stack.header_grid) for stack in stacks])
    return replace(slices, header_pose=header_from_stack.take(slices.stack_id) @ slices.header_pose)


def slice_spacing_mm(stack: Slices) -> float:
    """Median distance between neighbouring slices of one stack by the header; the thickness of a single slice."""
    return float(np.median(np.abs(steps_along_normal_mm(stack))))


def steps_along_normal_mm(stack: Slices) -> NDArray[np.float64]:
    """Steps [K - 1] from one slice number of a stack to the next along the normal, by the header.

    Negative where the numbers rise against the normal; the thickness of a single slice [1].
    """
    return _steps_mm(stack, np.arange(len(stack)))


def spacing_of_each_mm(slices: Slices) -> NDArray[np.float64]:
    """Slice spacing [K] of the stack of each slice, see `slice_spacing_mm`; no pixels are copied."""
    spacing_mm = np.empty(len(slices))
    for stack in np.unique(slices.stack_id):
        rows = np.flatnonzero(slices.stack_id == stack)
        spacing_mm[rows] = np.median(np.abs(_steps_mm(slices, rows)))
    return spacing_mm


def _steps_mm(slices: Slices, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """`steps_along_normal_mm` of the slices [K] of one stack among others."""
    if len(rows) < 2:
        return slices.thickness_mm[rows]
    header = slices.header_pose.take(rows)
    return np.diff(header.translation_mm @ header.rotation[0, :, 2]) / np.diff(slices.slice_index[rows])


def skipped_slice_notes(stacks: Sequence[Stack], slices: Slices) -> list[str]:
    """A line for each stack with skipped slices, which have too few masked pixels or no image.

    Args:
        stacks: as they were given.
        slices: `slices_from_stacks` of them.
    """
    lines = []
    for n, stack in enumerate(stacks):
        masked = np.flatnonzero(stack.mask.any((0, 1)))
        missing = set(masked.tolist()) - set(slices.slice_index[slices.stack_id == n].tolist())
        blank = missing & set(np.flatnonzero(_blank(stack)).tolist())
        for rows, why in (
            (missing - blank, f"fewer than {MIN_SLICE_PIXELS} masked pixels"),
            (blank, "blank inside the mask: they count as not taken"),
        ):
            if rows:
                lines.append(f"{stack.name}: slices {', '.join(map(str, sorted(rows)))} skipped, {why}")
    return lines
