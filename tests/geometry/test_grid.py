"""Voxel grids: index and world coordinates, bounding boxes, resampling, refusals."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g3r.geometry import RigidPose, VolumeGrid
from g3r.geometry.grid import SLAB, bounding_box, on_grid


def affine_of(axes: np.ndarray, spacing: tuple[float, float, float], origin: tuple[float, ...]) -> np.ndarray:
    affine = np.eye(4)
    affine[:3, :3] = axes * np.array(spacing)
    affine[:3, 3] = origin
    return affine


AXES = {
    "RAS": np.eye(3),
    "LAS": np.diag([-1.0, 1, 1]),
    "LPS": np.diag([-1.0, -1, 1]),
    "oblique": Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix(),
    "oblique left-handed": Rotation.from_rotvec([1.3, 0.5, -0.9]).as_matrix() @ np.diag([1.0, -1, 1]),
}


def test_a_grid_scaled_about_a_point_keeps_that_point_and_its_shape() -> None:
    grid = VolumeGrid((4, 5, 6), affine_of(AXES["oblique"], (1.0, 2.0, 3.0), (5.0, -7.0, 2.0)))
    center_mm = np.array([3.0, 1.0, -4.0])
    scaled = grid.scaled_about(center_mm, 1.5)
    index = np.array([[0.0, 0, 0], [3, 4, 5], [1.5, 2, 0.5]])
    np.testing.assert_allclose(scaled.world(index) - center_mm, 1.5 * (grid.world(index) - center_mm), atol=1e-12)
    np.testing.assert_allclose(scaled.index(center_mm), grid.index(center_mm), atol=1e-12)
    assert scaled.shape == grid.shape


@pytest.mark.parametrize("name", AXES)
def test_axes_are_unit_vectors_and_the_frame_of_a_plane_is_right_handed(name: str) -> None:
    grid = VolumeGrid((4, 5, 6), affine_of(AXES[name], (1.0, 2.0, 3.0), (5.0, -7.0, 2.0)))
    np.testing.assert_allclose(grid.axes, AXES[name], atol=1e-12)
    assert grid.shear < 1e-12
    np.testing.assert_allclose(grid.plane_frame[:, :2], AXES[name][:, :2], atol=1e-12)
    assert np.linalg.det(grid.plane_frame) == pytest.approx(1)


def test_the_shear_is_the_largest_cosine_between_axes() -> None:
    axes = AXES["oblique"].copy()
    axes[:, 2] = 0.8 * axes[:, 2] - 0.6 * axes[:, 0]
    assert VolumeGrid((4, 5, 6), affine_of(axes, (1.0, 2.0, 3.0), (5.0, -7.0, 2.0))).shear == pytest.approx(0.6)


@pytest.mark.parametrize("origin", [(-40.0, 30.0, 12.5), (1e4, -1e4, 1e4)])
@pytest.mark.parametrize("name", AXES)
def test_world_and_index_are_inverse(name: str, origin: tuple[float, float, float]) -> None:
    grid = VolumeGrid((30, 41, 17), affine_of(AXES[name], (0.7, 0.8, 3.3), origin))
    index = np.random.default_rng(0).uniform(-5, 45, (200, 3))
    world = grid.world(index)
    np.testing.assert_allclose(grid.world(grid.index(world)), world, rtol=0, atol=1e-9)
    np.testing.assert_allclose(world, (grid.affine @ np.c_[index, np.ones(200)].T)[:3].T, atol=1e-9)
    np.testing.assert_allclose(grid.spacing_mm, [0.7, 0.8, 3.3], atol=1e-12)
    assert grid.voxel_volume_mm3 == pytest.approx(0.7 * 0.8 * 3.3)
    np.testing.assert_allclose(grid.center_mm, grid.world([14.5, 20, 8]), atol=1e-9)


@pytest.mark.parametrize("spacing", [0.5, 0.8, 3.0])
@pytest.mark.parametrize("margin", [0.0, 5.0])
def test_isotropic_covers_its_box_and_little_more(spacing: float, margin: float) -> None:
    low, high = np.array([-31.2, -40.05, 7.0]), np.array([28.3, 41.0, 7.3])
    grid = VolumeGrid.isotropic(low, high, spacing, margin)
    first, last = grid.world([0, 0, 0]), grid.world(np.array(grid.shape) - 1)
    assert (first <= low - margin + 1e-9).all()
    assert (last >= high + margin - 1e-9).all()
    assert (last - first < high - low + 2 * margin + spacing).all()
    np.testing.assert_allclose(grid.spacing_mm, spacing)
    np.testing.assert_allclose(grid.center_mm, (low + high) / 2, atol=1e-12)


def test_isotropic_of_a_point_is_one_voxel() -> None:
    grid = VolumeGrid.isotropic([1, 2, 3], [1, 2, 3], 0.8)
    assert grid.shape == (1, 1, 1)
    np.testing.assert_allclose(grid.world([0, 0, 0]), [1, 2, 3])


@pytest.mark.parametrize(
    ("shape", "affine", "message"),
    [
        ((0, 3, 3), np.eye(4), "positive"),
        ((3, 3), np.eye(4), "positive"),
        ((3, 3, 3), np.eye(3), "4x4"),
        ((3, 3, 3), np.full((4, 4), np.nan), "finite"),
        ((3, 3, 3), np.diag([1.0, 0, 1, 1]), "singular"),
        ((3, 3, 3), np.array([[1.0, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "singular"),
    ],
)
def test_what_is_no_grid_is_refused(shape: Any, affine: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        VolumeGrid(shape, affine)


def test_small_voxels_are_not_taken_for_singular() -> None:
    assert VolumeGrid((3, 3, 3), np.diag([1e-4, 1e-4, 1e-4, 1])).voxel_volume_mm3 == pytest.approx(1e-12)


def test_a_mask_has_the_volume_of_its_voxels() -> None:
    mask = np.zeros((3, 4, 5), bool)
    mask[0, :2, 1:4] = True
    assert VolumeGrid(mask.shape, np.diag([-10.0, 5.0, 2.0, 1.0])).volume_ml(mask) == pytest.approx(0.6)


def test_a_moved_grid_has_its_voxels_where_the_motion_puts_them() -> None:
    grid = VolumeGrid((3, 4, 5), affine_of(AXES["LAS"], (0.8, 1.0, 2.0), (4.0, -3.0, 2.0)))
    motion = RigidPose.from_rotvec([[0.3, -0.2, 0.1]], [[5.0, 6.0, -7.0]])
    index = np.array([[0.0, 0, 0], [2, 3, 4]])
    np.testing.assert_allclose(grid.moved(motion).world(index), motion.apply(grid.world(index)[None])[0], atol=1e-12)


def test_a_bounding_box_holds_the_mask_and_its_grid_the_same_places() -> None:
    mask = np.zeros((7, 9, 5), bool)
    mask[2:5, 4, 1:3] = True
    mask[3, 6, 1] = True
    assert bounding_box(mask) == (slice(2, 5), slice(4, 7), slice(1, 3))
    assert bounding_box(mask, 2) == (slice(0, 7), slice(2, 9), slice(0, 5))
    assert bounding_box(mask, (1, 0, 0)) == (slice(1, 6), slice(4, 7), slice(1, 3))
    assert bounding_box(mask[3]) == (slice(4, 7), slice(1, 3))
    grid = VolumeGrid.isotropic((-3, -4, -2), (3, 4, 2), 1.0)
    inner = grid.cropped(bounding_box(mask))
    assert inner.shape == mask[bounding_box(mask)].shape
    np.testing.assert_allclose(inner.world((1, 2, 0)), grid.world((3, 6, 1)))
    with pytest.raises(ValueError, match="mask is empty"):
        bounding_box(np.zeros((3, 3, 3), bool))


def test_a_map_read_on_another_grid_is_trilinear_and_known_outside(rng: np.random.Generator) -> None:
    source = VolumeGrid.isotropic((0, 0, 0), (9, 9, 9), 1.0)
    data = np.add.outer(np.add.outer(np.arange(10.0), 2 * np.arange(10)), 3 * np.arange(10))
    target = VolumeGrid.isotropic((2, 2, 2), (12, 5, 5), 0.5)
    found = on_grid(data, source, target, outside=-1.0)
    place = target.world((4, 3, 1))
    assert found[4, 3, 1] == pytest.approx(place @ [1, 2, 3])
    assert found[-1, 0, 0] == -1
    np.testing.assert_array_equal(on_grid(data, source, source, outside=0.0), data.astype(np.float32))


def test_a_map_of_several_slabs_reads_the_same_ramp_on_another_grid() -> None:
    source = VolumeGrid((30, 40, 35), affine_of(AXES["oblique"], (2.0, 1.5, 1.8), (3.0, -5.0, 7.0)))
    index = np.stack(np.meshgrid(*[np.arange(n) for n in source.shape], indexing="ij"), -1)
    target = VolumeGrid((SLAB + 5, 4, 3), affine_of(AXES["oblique"], (0.7, 1.0, 1.0), (13.0, 11.0, 27.0)))
    expected = target.world(np.stack(np.meshgrid(*[np.arange(n) for n in target.shape], indexing="ij"), -1)).sum(-1)
    found = on_grid(source.world(index).sum(-1), source, target, outside=np.nan)
    inside = np.isfinite(found)
    assert inside[: SLAB - 1].any()
    assert inside[SLAB + 1 :].any()
    np.testing.assert_allclose(found[inside], expected[inside], rtol=1e-4)
