"""One acquisition in files of different programs gives the same arrays and bit-identical geometry."""

from __future__ import annotations

import itertools

import nibabel as nib
import numpy as np
import pytest
from nibabel.orientations import apply_orientation, inv_ornt_aff
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.acquisition.file_axes import FileAxes, settled
from g3r.geometry import VolumeGrid

SHAPE = (30, 24, 9)
ORIENTATIONS = [np.array(signs) for signs in itertools.product((1, -1), repeat=2)]


def oblique(seed: int, spacing_mm: tuple[float, float, float] = (1.171875, 1.171875, 3.3)) -> VolumeGrid:
    """An oblique grid as from a scanner, right- or left-handed."""
    rng = np.random.default_rng(seed)
    affine = np.eye(4)
    affine[:3, :3] = Rotation.random(random_state=seed).as_matrix() * spacing_mm * rng.choice([-1, 1], 3)
    affine[:3, 3] = rng.uniform(-200, 200, 3)
    return VolumeGrid(SHAPE, affine)


def by_another_program(grid: VolumeGrid, flips: NDArray[np.int64], seed: int) -> VolumeGrid:
    """The grid with rows and columns in another order and the digits of a float32 header."""
    turn = np.column_stack([range(3), [*flips, 1]])
    affine = (grid.affine @ inv_ornt_aff(turn, SHAPE)).astype(np.float32).astype(np.float64)
    affine[:3, 3] += np.random.default_rng(seed).uniform(-1e-6, 1e-6, 3)
    return VolumeGrid(SHAPE, affine)


def test_the_file_is_given_back_in_its_own_axes() -> None:
    values = np.arange(np.prod(SHAPE)).reshape(SHAPE)
    for order in itertools.permutations(range(3)):
        turned = values.transpose(order)
        affine = oblique(3).affine
        affine[:3, :3] = affine[:3, order]
        grid = VolumeGrid(turned.shape, affine)
        axes = FileAxes.of(grid, order.index(2))
        there = axes.from_file(turned)
        assert there.shape[2] == SHAPE[2]
        assert there.flags.c_contiguous
        np.testing.assert_array_equal(axes.to_file(there), turned)
        inside = axes.grid_from_file(grid)
        np.testing.assert_allclose(axes.grid_to_file(inside).affine, affine, atol=1e-10)
        at = np.argwhere(there == 1234)[0], np.argwhere(turned == 1234)[0]
        np.testing.assert_allclose(inside.world(at[0]), grid.world(at[1]), atol=1e-10)


@pytest.mark.parametrize("flips", ORIENTATIONS, ids=str)
def test_rows_have_one_order_whoever_wrote_the_file(flips: NDArray[np.int64]) -> None:
    values = np.random.default_rng(0).random(SHAPE)
    for seed in range(20):
        grid = oblique(seed)
        other = by_another_program(grid, flips, seed)
        turned = apply_orientation(values, np.column_stack([range(3), [*flips, 1]]))
        np.testing.assert_array_equal(FileAxes.of(grid, 2).from_file(values), FileAxes.of(other, 2).from_file(turned))


def test_the_geometry_is_the_same_to_the_last_bit() -> None:
    """Except for a few of many acquisitions, whose values lie on the boundary of rounding."""
    n, differ = 300, 0
    for seed in range(n):
        grid = oblique(seed)
        other = by_another_program(grid, ORIENTATIONS[seed % 4], seed)
        one, two = (settled(FileAxes.of(g, 2).grid_from_file(g)) for g in (grid, other))
        differ += not np.array_equal(one.affine, two.affine)
    assert differ < 0.05 * n


@pytest.mark.parametrize("spacing_mm", [(0.8, 0.8, 2.2), (1.171875, 1.171875, 3.3), (0.9375, 0.7, 2.75)], ids=str)
def test_points_stay_where_they_are(spacing_mm: tuple[float, float, float]) -> None:
    for seed in range(50):
        grid = oblique(seed, spacing_mm)
        there = settled(grid)
        np.testing.assert_allclose(there.spacing_mm, spacing_mm, rtol=0, atol=1e-12)
        assert np.linalg.det(there.affine[:3, :3]) * np.linalg.det(grid.affine[:3, :3]) > 0
        directions = np.random.default_rng(seed).standard_normal((40, 3))
        around = grid.center_mm + 120 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        moved = there.world(grid.index(around)) - around
        assert np.linalg.norm(moved, axis=1).max() < 0.02


@pytest.mark.parametrize("code", ["RAS", "LPS", "SRA", "ILP"])
def test_frames_along_the_axes_are_exact(code: str) -> None:
    affine = inv_ornt_aff(nib.orientations.axcodes2ornt(tuple(code)), SHAPE) * np.array([[0.8], [0.8], [2.2], [1]])
    there = settled(VolumeGrid(SHAPE, affine))
    np.testing.assert_allclose(there.affine[:3, :3], affine[:3, :3], atol=1e-15)


def test_shear_is_kept() -> None:
    grid = oblique(1)
    sheared = VolumeGrid(SHAPE, grid.affine @ (np.eye(4) + 1e-3 * np.eye(4, k=1)))
    there = settled(sheared)
    corners = sheared.corner_index
    assert np.linalg.norm(there.world(corners) - sheared.world(corners), axis=1).max() < 0.02
