"""Grouping of slices into stacks without an index."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.reuse.slice_files import SliceFile
from g3r.reuse.slice_groups import SliceGroup, grouped_by_headers
from tests.reuse.slice_writer import AXIAL, CORONAL, SAGITTAL, poses

Affine = NDArray[np.float64]


def files(affines: list[Affine], numbers: list[int] | None = None) -> list[SliceFile]:
    """Slice files with irrelevant pixel values."""
    rows = numbers or list(range(len(affines)))
    blank = np.zeros((30, 34), np.float32)
    return [
        SliceFile(number=n, path=Path(f"{n}.nii.gz"), mask_path=None, image=blank, mask=blank > 0, affine=affine)
        for n, affine in zip(rows, affines, strict=True)
    ]


def grouped(affines: list[Affine], numbers: list[int] | None = None) -> list[SliceGroup]:
    return grouped_by_headers(files(affines, numbers))


def numbers_of(groups: list[SliceGroup]) -> list[list[int]]:
    return [[one.number for one in group.files] for group in groups]


def shifted(affine: Affine, along: int) -> Affine:
    """A slice moved along its normal by a number of thicknesses."""
    moved = affine.copy()
    moved[:3, 3] += along * affine[:3, 2]
    return moved


def turned(affine: Affine, deg: float, axis: int) -> Affine:
    """A slice rotated about one of its own axes through the origin of the world."""
    matrix = np.eye(4)
    normal = affine[:3, axis] / np.linalg.norm(affine[:3, axis])
    matrix[:3, :3] = Rotation.from_rotvec(np.deg2rad(deg) * normal).as_matrix()
    return matrix @ affine


@pytest.mark.parametrize("mm", [0.0, 1.5])
def test_stacks_of_three_planes(mm: float, rng: np.random.Generator) -> None:
    counts = [12, 9, 14]
    affines = [
        one
        for frame, n in zip((AXIAL, CORONAL, SAGITTAL), counts, strict=True)
        for one in poses(frame, n, rng, deg=4 * mm, mm=mm)
    ]
    found = grouped(affines)
    assert [len(group.files) for group in found] == counts
    for group in found:
        np.testing.assert_array_equal(group.place, np.arange(len(group.files)))


def test_two_stacks_of_one_plane_begin_anew(rng: np.random.Generator) -> None:
    """Both stacks in the same direction, and the second one reversed."""
    first, second, third = (poses(AXIAL, n, rng) for n in (12, 10, 11))
    assert [len(group.files) for group in grouped([*first, *second, *third])] == [12, 10, 11]
    found = grouped([*first[::-1], *second[::-1]])
    assert [len(group.files) for group in found] == [12, 10]


def test_two_stacks_of_one_plane_turned_in_it(rng: np.random.Generator) -> None:
    """Pixel axes differ by 90 degrees, so the stacks cannot share a bias field in pixels."""
    first = poses(AXIAL, 10, rng)
    second = [turned(one, 90, 2) for one in first]
    assert [len(group.files) for group in grouped([*first, *second])] == [10, 10]


def test_other_pixels_or_thickness_are_another_stack(rng: np.random.Generator) -> None:
    first = poses(AXIAL, 8, rng, deg=0, mm=0)
    finer, thicker = [one.copy() for one in first], [one.copy() for one in first]
    for one in finer:
        one[:3, 0] *= 0.8
    for one in thicker:
        one[:3, 2] *= 1.2
    assert numbers_of(grouped([*first, *(shifted(one, 8) for one in finer)])) == [list(range(8)), list(range(8, 16))]
    found = grouped([*first, *(shifted(one, 8) for one in thicker)])
    assert numbers_of(found) == [list(range(8)), list(range(8, 16))]


@pytest.mark.parametrize("n_passes", [2, 3])
def test_passes_of_an_interleaved_stack_are_one(n_passes: int, rng: np.random.Generator) -> None:
    """Slices are numbered in order of acquisition, and their order in space is recovered."""
    affines = poses(CORONAL, 18, rng, deg=1, mm=0.2)
    order = [k for start in range(n_passes) for k in range(start, 18, n_passes)]
    (found,) = grouped([affines[k] for k in order])
    np.testing.assert_array_equal(found.place, np.arange(18))
    assert [order[one.number] for one in found.files] == list(range(18))


def test_a_stack_with_gaps_twice_is_no_interleaved_stack(rng: np.random.Generator) -> None:
    """Both passes have the same positions, so no slice lies between those of the first."""
    affines = poses(AXIAL, 18, rng, deg=0, mm=0)[::2]
    assert [len(group.files) for group in grouped([*affines, *affines])] == [9, 9]


@pytest.mark.parametrize("at", [0, 5, 11])
def test_a_slice_that_went_astray_is_no_stack(at: int, rng: np.random.Generator) -> None:
    affines = poses(AXIAL, 12, rng)
    affines[at] = turned(affines[at], 70, 0)
    next_ones = poses(SAGITTAL, 9, rng)
    # no earlier slice shows where the stack is
    expected = [1, 11, 9] if at == 0 else [12, 9]
    assert [len(group.files) for group in grouped([*affines, *next_ones])] == expected


def test_slices_that_were_left_out_leave_holes(rng: np.random.Generator) -> None:
    """Holes are found by missing numbers, or by a jump in position if the slices were renumbered."""
    affines = poses(AXIAL, 20, rng, deg=1, mm=0.3)
    kept = [k for k in range(20) if k not in (4, 9, 10, 11)]
    (by_number,) = grouped([affines[k] for k in kept], kept)
    np.testing.assert_array_equal(by_number.place, kept)
    kept = [k for k in range(20) if k not in (9, 10, 11)]
    (by_jump,) = grouped([affines[k] for k in kept])
    np.testing.assert_array_equal(by_jump.place, kept)
    (every_tenth,) = grouped(affines, [10 * k for k in range(20)])
    np.testing.assert_array_equal(every_tenth.place, np.arange(20))


@pytest.mark.parametrize("deg", [0.0, 10.0])
def test_motion_makes_no_hole(deg: float, rng: np.random.Generator) -> None:
    """A jerk of four slices and back, and one that lasts and rotates the head."""
    affines = poses(AXIAL, 24, rng, deg=1, mm=0.3)
    back = 24 if deg else 16
    jerk = [turned(shifted(one, 3), deg, 0) if 8 <= k < back else one for k, one in enumerate(affines)]
    (found,) = grouped(jerk)
    np.testing.assert_array_equal(found.place, np.arange(24))


def test_a_slice_far_back_is_no_new_stack(rng: np.random.Generator) -> None:
    affines = poses(AXIAL, 20, rng)
    affines[14] = shifted(affines[14], -11)
    (found,) = grouped(affines)
    np.testing.assert_array_equal(found.place, np.arange(20))
