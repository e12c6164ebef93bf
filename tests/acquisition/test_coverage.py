"""Density of whole slices: equal to brute-force integration of Eq. 6, and independent of the masks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g3r.acquisition.coarse_volume import coarse_and_density
from g3r.acquisition.coverage import brain_share, coverage
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack
from g3r.geometry import RigidPose, VolumeGrid

GRID = VolumeGrid.isotropic([-12, -12, -14], [12, 12, 14], 1.5)
ALL = (slice(None),) * 3


def stack(
    shape: tuple[int, int, int] = (30, 24, 10),
    *,
    pixel_mm: tuple[float, float] = (1.0, 1.3),
    thickness_mm: float = 3.0,
    slice_spacing_mm: float | None = None,
    turn: np.ndarray | None = None,
    masked: tuple[slice, ...] = ALL,
    dark: slice = slice(0, 0),
) -> Stack:
    """A stack about the origin with a box as mask and some blank slices."""
    spacing = np.array([*pixel_mm, thickness_mm if slice_spacing_mm is None else slice_spacing_mm])
    affine = np.eye(4)
    affine[:3, :3] = (np.eye(3) if turn is None else turn) * spacing
    affine[:3, 3] = -affine[:3, :3] @ ((np.array(shape) - 1) / 2)
    image = 100 + np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
    mask = np.zeros(shape, bool)
    mask[masked] = True
    image[:, :, dark], mask[:, :, dark] = 0, False
    return Stack(image=image, mask=mask, affine=affine, thickness_mm=thickness_mm)


def shaken(slices: Slices) -> Slices:
    """The slices, each in a different oblique pose."""
    turn = Rotation.from_euler("xyz", [35, -20, 50], degrees=True) * Rotation.from_rotvec(
        0.1 * np.random.default_rng(0).standard_normal((len(slices), 3))
    )
    shift = np.random.default_rng(1).normal(0, 1.5, (len(slices), 3))
    return slices.with_motion(RigidPose(turn.as_matrix(), shift))


def integrated(slices: Slices, points: np.ndarray) -> np.ndarray:
    """Eq. 6 at points [N, 3]: thickness times the PSF, summed over pixels of a fiftieth of a sigma."""
    planes, extent = slices.planes, slices.fields_of_view.extent_mm
    density = np.zeros(len(points))
    for k in range(len(slices)):
        var = planes.psf_var_mm2[k]
        local = (points - planes.center_mm[k]) @ planes.rotation[k]
        through = np.exp(-0.5 * local[:, 2] ** 2 / var[2]) / np.sqrt(2 * np.pi * var[2])
        value = slices.thickness_mm[k] * through
        for axis in range(2):
            low, high = extent[k, axis]
            n = int(np.ceil((high - low) / (0.02 * np.sqrt(var[axis]))))
            pixel = low + (high - low) * (np.arange(n) + 0.5) / n
            gauss = np.exp(-0.5 * (local[:, axis, None] - pixel) ** 2 / var[axis]) / np.sqrt(2 * np.pi * var[axis])
            value = value * gauss.sum(1) * (high - low) / n
        density += value
    return density


def at_voxels(grid: VolumeGrid) -> np.ndarray:
    return grid.world(np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), -1).reshape(-1, 3))


def test_it_is_the_integral_of_eq_6_edges_included() -> None:
    whole = slices_from_stacks([stack((9, 12, 6), masked=(slice(1, 6), slice(2, 9), slice(None)))])
    slices = shaken(whole.take(np.array([0, 2, 3])))
    expected = integrated(slices, at_voxels(GRID)).reshape(GRID.shape)
    # the points lie inside, outside and at the edges of the fields of view
    assert ((expected > 0.1) & (expected < 0.5)).sum() > 300
    assert (expected > 0.8).sum() > 100
    assert (expected < 1e-6).sum() > 300
    np.testing.assert_allclose(coverage(slices, GRID), expected, atol=2e-5)
    weight = np.array([0.3, 1.0, 0.0])
    by_slice = [integrated(slices.take(np.array([k])), at_voxels(GRID)).reshape(GRID.shape) for k in range(3)]
    expected = sum(w * one for w, one in zip(weight, by_slice, strict=True))
    np.testing.assert_allclose(coverage(slices, GRID, weight), expected, atol=2e-5)


@pytest.mark.parametrize("pixel_mm", [(0.5, 0.5), (2.0, 1.1)])
@pytest.mark.parametrize("thickness_mm", [2.0, 4.5])
@pytest.mark.parametrize("voxel_mm", [0.6, 1.7])
def test_one_gapless_stack_covers_once(pixel_mm: tuple[float, float], thickness_mm: float, voxel_mm: float) -> None:
    turn = Rotation.from_euler("zx", [30, 40], degrees=True).as_matrix()
    shape = (int(50 / pixel_mm[0]), int(50 / pixel_mm[1]), 12)
    masked = (slice(3, 20), slice(5, 19), slice(4, 8))
    slices = slices_from_stacks([stack(shape, pixel_mm=pixel_mm, thickness_mm=thickness_mm, turn=turn, masked=masked)])
    density = coverage(slices, VolumeGrid.isotropic([-6] * 3, [6] * 3, voxel_mm))
    # Gaussians of this width at this spacing ripple by 5.7 %
    assert density.mean() == pytest.approx(1, abs=0.01)
    assert 0.94 < density.min() <= density.max() < 1.06
    gap = slices_from_stacks(
        [stack(shape, pixel_mm=pixel_mm, thickness_mm=thickness_mm, slice_spacing_mm=2 * thickness_mm, turn=turn)]
    )
    assert coverage(gap, VolumeGrid.isotropic([-6] * 3, [6] * 3, voxel_mm)).mean() == pytest.approx(0.5, abs=0.12)


@pytest.mark.parametrize(
    "masked",
    [
        (slice(2, 9), slice(4, 11), slice(None)),
        (slice(2, 9), slice(4, 11), slice(4, 6)),  # slices beyond the masked ones have been looked at
        (slice(25, 30), slice(0, 4), slice(9, 10)),
    ],
)
def test_masks_say_nothing(masked: tuple[slice, ...]) -> None:
    whole, part = (coverage(slices_from_stacks([stack(masked=box)]), GRID) for box in (ALL, masked))
    assert whole.max() > 0.9
    np.testing.assert_allclose(part, whole, atol=1e-5)


def height_profile(slices: Slices) -> np.ndarray:
    """Coverage on the axis of a stack along z, at the centres of its ten slices."""
    line = VolumeGrid((1, 1, 10), np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 3.0, -13.5], [0, 0, 0, 1.0]]))
    return coverage(slices, line)[0, 0]


NEIGHBOUR = 0.939 * np.exp(-0.5 * 2.3548**2)
"""Contribution of a slice to the density at the centre of the next slice: a sixteenth."""


def test_blank_and_unmasked_slices_within_do_not_cover() -> None:
    full = height_profile(slices_from_stacks([stack()]))
    np.testing.assert_allclose(full[1:-1], 0.939 + 2 * NEIGHBOUR, atol=2e-3)
    blank = height_profile(slices_from_stacks([stack(dark=slice(4, 6))]))
    np.testing.assert_allclose(blank[4:6], NEIGHBOUR, atol=2e-3)
    np.testing.assert_allclose(blank[[1, 2, 7, 8]], full[1], atol=2e-3)
    # with signal but without a mask: excluded by the user or while reading the files
    one = stack()
    mask = one.mask.copy()
    mask[:, :, 4:6] = False
    np.testing.assert_allclose(height_profile(slices_from_stacks([replace(one, mask=mask)])), blank, atol=1e-6)


def test_slices_without_weight_do_not_cover() -> None:
    slices = slices_from_stacks([stack()])
    weight = np.where((slices.slice_index >= 4) & (slices.slice_index < 6), 0.0, 1.0)
    line = height_profile(slices_from_stacks([stack(dark=slice(4, 6))]))
    grid = VolumeGrid((1, 1, 10), np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 3.0, -13.5], [0, 0, 0, 1.0]]))
    np.testing.assert_allclose(coverage(slices, grid, weight)[0, 0], line, atol=1e-6)


def test_slices_beyond_the_ends_cover_up_to_a_blank_one() -> None:
    middle = (slice(None), slice(None), slice(4, 6))
    assert height_profile(slices_from_stacks([stack(masked=middle)])).min() > 0.9
    cut = height_profile(slices_from_stacks([stack(masked=middle, dark=slice(7, 8))]))
    np.testing.assert_allclose(cut[6:9], [0.939 + NEIGHBOUR, NEIGHBOUR, 0], atol=3e-3)
    assert cut[:6].min() > 0.9
    # a blank slice ends the coverage on its side, whatever comes after it
    other = height_profile(slices_from_stacks([stack(masked=middle, dark=slice(2, 3))]))
    np.testing.assert_allclose(other, cut[::-1], atol=1e-5)


def test_slices_beyond_the_ends_move_with_the_last_masked_one() -> None:
    slices = slices_from_stacks([stack(masked=(slice(None), slice(None), slice(3, 8)))])
    weight = np.zeros(len(slices))
    weight[-1] = 1  # slice 7, and with it 8 and 9
    assert slices.fields_of_view.n_beyond.tolist() == [[3, 0], [0, 0], [0, 0], [0, 0], [0, 2]]
    turn = np.tile(Rotation.from_euler("y", 90, degrees=True).as_matrix(), (len(slices), 1, 1))
    moved = slices.with_motion(RigidPose(turn, np.zeros((len(slices), 3))))
    line = VolumeGrid((10, 1, 1), np.array([[3.0, 0, 0, -13.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    found = coverage(moved, line, weight)[:, 0, 0]
    np.testing.assert_allclose(found[:6], 0, atol=1e-3)
    np.testing.assert_allclose(found[6:], [NEIGHBOUR, 1.0, 1.06, 1.0], atol=4e-3)


@pytest.mark.parametrize("tilt", [0.0, 1e-13, 1e-3])
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_the_grid_s_axes_may_lie_in_or_across_the_slices(tilt: float, order: tuple[int, int, int]) -> None:
    """Sums run along rows of the grid, which pass through the slices or lie within one."""
    turn = Rotation.from_euler("x", tilt).as_matrix()
    slices = slices_from_stacks([stack((16, 14, 5), turn=turn)])
    affine = GRID.affine.copy()
    affine[:, :3] = affine[:, [*order]]
    shape = tuple(GRID.shape[axis] for axis in order)
    found = coverage(slices, VolumeGrid((shape[0], shape[1], shape[2]), affine))
    expected = integrated(slices, at_voxels(GRID)).reshape(GRID.shape).transpose(order)
    np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("flip", [0, 2])
def test_left_handed_headers_are_the_same_stack(flip: int) -> None:
    right = stack((20, 24, 8), masked=(slice(2, 9), slice(4, 11), slice(1, 4)), dark=slice(6, 7))
    affine = right.affine.copy()
    affine[:3, 3] += affine[:3, flip] * (right.image.shape[flip] - 1)
    affine[:3, flip] *= -1
    left = replace(right, image=np.flip(right.image, flip), mask=np.flip(right.mask, flip), affine=affine)
    assert np.linalg.det(left.affine[:3, :3]) < 0
    one, other = (coverage(slices_from_stacks([given]), GRID) for given in (right, left))
    np.testing.assert_allclose(one, other, atol=1e-5)


def test_the_share_of_brain_is_that_of_the_masks() -> None:
    slices = slices_from_stacks([stack(masked=(slice(8, 22), slice(6, 18), slice(2, 8)))])
    world = at_voxels(GRID).reshape(*GRID.shape, 3)
    density = coverage(slices, GRID)
    share = brain_share(coarse_and_density(slices, GRID)[1], density)
    assert share.dtype == np.float32
    assert 0 <= share.min() <= share.max() <= 1
    inside = (np.abs(world) < [5.5, 6, 7]).all(-1)
    outside = (np.abs(world[..., 0]) > 9.5) & (np.abs(world[..., 2]) < 13)
    assert share[inside].min() > 0.9
    assert outside.sum() > 100
    assert density[outside].min() > 0.9
    assert share[outside].max() < 0.02
    nothing = brain_share(np.full(2, 0.1, np.float32), np.array([0.0, 5e-4], np.float32))
    assert nothing.tolist() == [0, 0]
