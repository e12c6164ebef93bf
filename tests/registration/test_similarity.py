"""Costs of slices under candidate motions, against plain numpy and scipy."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes, Slices
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration.pose_sampling import perturbed
from g3r.registration.similarity import (
    CORRELATION_AREA_MM2,
    GAIN_RANGE,
    SearchPixels,
    best_gain,
    halved_voxels,
    mean_square_residual,
    own_moments,
    student_cost,
)
from tests.registration.moving_heads import slices_disturbed

CENTER_MM = np.array([10.0, -20.0, 30.0])


def few_slices(n: int = 7) -> Slices:
    """Slices of different sizes and masks with random values, in arbitrary poses."""
    rng = np.random.default_rng(5)
    shape = rng.integers(3, 40, (n, 2))
    planes = Planes(
        rotation=Rotation.random(n, rng=rng).as_matrix(),
        center_mm=rng.normal(0, 8, (n, 3)) + CENTER_MM,
        spacing_mm=rng.uniform(0.7, 1.5, (n, 2)),
        shape=shape,
        psf_var_mm2=np.zeros((n, 3)),
    )
    value = rng.random(planes.n_pixels).astype(np.float32)
    mask = rng.random(planes.n_pixels) < 0.7
    return Slices(
        planes=planes,
        value=value,
        mask=mask,
        stack_id=np.arange(n) % 2,
        slice_index=np.arange(n),
        thickness_mm=np.full(n, 3.0),
        header_pose=planes.pose,
    )


def test_search_pixels_are_a_lattice_of_every_slice_zero_outside_the_mask() -> None:
    slices = few_slices()
    pixels = SearchPixels.of(slices, pixels_per_slice=60)
    assert len(pixels) == len(slices)
    assert pixels.start[0] == 0
    assert pixels.start[-1] == len(pixels.point_mm) == len(pixels.value)
    for k in range(len(slices)):
        points = pixels.point_mm[pixels.start[k] : pixels.start[k + 1]]
        values = pixels.value[pixels.start[k] : pixels.start[k + 1]]
        own = np.arange(slices.planes.offset[k], slices.planes.offset[k + 1])
        n = slices.planes.shape[k].prod()
        assert min(n, 60) / 2.5 < len(points) <= 3 * 60
        distance = np.linalg.norm(points[:, None] - slices.planes.pixel_world_mm(own)[None], axis=2)
        assert distance.min(1).max() < 1e-9
        nearest = own[distance.argmin(1)]
        assert len(set(nearest.tolist())) == len(nearest)
        np.testing.assert_array_equal(values, np.where(slices.mask[nearest], slices.value[nearest], 0))
        size_mm = slices.planes.shape[k] * slices.planes.spacing_mm[k]
        assert pixels.area_mm2[k] == pytest.approx(size_mm.prod())


def test_a_slice_of_one_row_and_a_slice_without_mask_have_pixels_too() -> None:
    planes = Planes(
        rotation=np.tile(np.eye(3), (2, 1, 1)),
        center_mm=np.zeros((2, 3)),
        spacing_mm=np.ones((2, 2)),
        shape=np.array([[1, 50], [20, 20]]),
        psf_var_mm2=np.zeros((2, 3)),
    )
    mask = np.zeros(450, bool)
    pixels = SearchPixels.of(
        Slices(
            planes=planes,
            value=np.ones(450, np.float32),
            mask=mask,
            stack_id=np.zeros(2, int),
            slice_index=np.arange(2),
            thickness_mm=np.ones(2),
            header_pose=planes.pose,
        ),
        16,
    )
    assert (np.diff(pixels.start) >= 10).all()
    assert (pixels.value == 0).all()
    assert np.isfinite(pixels.center_mm).all()


def plain_moments(
    pixels: SearchPixels, volume: np.ndarray, grid: VolumeGrid, motion: RigidPose, order: int = 1
) -> np.ndarray:
    """The six sums by scipy, trilinear or nearest-neighbour; the volume is 0 outside the voxel centres."""
    out = np.zeros((len(motion), len(pixels), 6))
    for j in range(len(motion)):
        moved = pixels.point_mm @ motion.rotation[j].T + motion.translation_mm[j]
        index = grid.index(moved)
        inside = ((index >= 0) & (index < np.array(grid.shape) - 1)).all(1)
        model = np.where(inside, map_coordinates(volume.astype(float), index.T, order=order), 0)
        for k in range(len(pixels)):
            rows = slice(pixels.start[k], pixels.start[k + 1])
            y, m = pixels.value[rows].astype(float), model[rows]
            out[j, k] = len(y), y.sum(), m.sum(), y @ y, m @ m, y @ m
    return out


def oblique_volume(rng: np.random.Generator) -> tuple[np.ndarray, VolumeGrid]:
    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix() * [-1.5, 2.0, 1.7]
    grid = VolumeGrid((14, 17, 12), affine)
    affine[:3, 3] = CENTER_MM - grid.center_mm
    return rng.random(grid.shape).astype(np.float32), VolumeGrid(grid.shape, affine)


@pytest.mark.parametrize("nearest", [False, True])
def test_moments_are_those_of_plain_reading(nearest: bool, rng: np.random.Generator) -> None:
    pixels = SearchPixels.of(few_slices())
    volume, grid = oblique_volume(rng)
    motion = perturbed(RigidPose.identity(1), CENTER_MM, 5, 30.0, 6.0, rng)
    expected = plain_moments(pixels, volume, grid, motion, order=0 if nearest else 1)
    found = pixels.moments(volume, grid, motion, nearest=nearest)
    assert (expected[..., 4] > 0).any()  # some pixels fall inside, some outside
    assert (expected[..., 2] < 0.4 * expected[..., 0]).any()
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-4)


def test_outside_of_the_volume_there_is_nothing(rng: np.random.Generator) -> None:
    pixels = SearchPixels.of(few_slices())
    volume, grid = oblique_volume(rng)
    far = RigidPose(np.eye(3)[None], np.array([[500.0, 0, 0]]))
    found = pixels.moments(volume, grid, far)
    assert (found[..., [2, 4, 5]] == 0).all()
    assert (found[..., 3] > 0).all()


def test_between_halved_voxels_a_volume_is_read_as_between_whole_ones(rng: np.random.Generator) -> None:
    volume, grid = oblique_volume(rng)
    fine, fine_grid = halved_voxels(volume, grid)
    assert fine.shape == fine_grid.shape == (27, 33, 23)
    np.testing.assert_allclose(fine_grid.spacing_mm, grid.spacing_mm / 2)
    index = rng.uniform(0, 1, (500, 3)) * (np.array(grid.shape) - 1)
    expected = map_coordinates(volume, index.T, order=1)
    found = map_coordinates(fine, fine_grid.index(grid.world(index)).T, order=1)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_costs_of_the_search_are_near_those_of_trilinear_reading(rng: np.random.Generator) -> None:
    pixels = SearchPixels.of(few_slices())
    noise, grid = oblique_volume(rng)
    volume = gaussian_filter(noise, 1.2)
    motion = perturbed(RigidPose.identity(1), CENTER_MM, 200, 10.0, 3.0, rng)
    trilinear = mean_square_residual(pixels.moments(volume, grid, motion))
    fine = mean_square_residual(pixels.moments(*halved_voxels(volume, grid), motion, nearest=True))
    coarse = mean_square_residual(pixels.moments(volume, grid, motion, nearest=True))
    spread = trilinear.std(0)
    assert (np.abs(fine - trilinear).mean(0) < 0.1 * spread).all()
    assert (np.abs(fine - trilinear).mean(0) < np.abs(coarse - trilinear).mean(0)).mean() > 0.8


def test_the_cost_of_a_slice_grows_with_its_area_and_with_the_logarithm_of_a_large_residual() -> None:
    area_mm2 = np.array([1.0, 3.0]) * CORRELATION_AREA_MM2
    residual = np.array([[0.0, 0.02, 20.0, 20_000.0]] * 2)
    small, large = student_cost(residual, 0.01, area_mm2)
    np.testing.assert_allclose(small[:2], [0.0, np.log(2)])
    assert small[3] - small[2] == pytest.approx(np.log(1000), rel=1e-3)
    np.testing.assert_allclose(large, 3 * small)


def test_each_slice_under_its_own_motion_is_the_diagonal(rng: np.random.Generator) -> None:
    slices = few_slices()
    pixels = SearchPixels.of(slices)
    volume, grid = oblique_volume(rng)
    disturbed = slices_disturbed(slices, 20.0, 3.0)
    motion = disturbed.world_from_header()
    every = pixels.moments(volume, grid, motion)
    own = own_moments(pixels, volume, grid, motion)
    np.testing.assert_allclose(own, every[np.arange(len(slices)), np.arange(len(slices))], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("gain", [0.1, 0.6, 0.97, 1.6, 5.0])
def test_the_residual_is_the_least_over_allowed_gains(gain: float, rng: np.random.Generator) -> None:
    m = rng.random((4, 50))
    y = gain * m + 0.1 * rng.normal(size=m.shape)
    moments = np.stack([np.full(4, 50.0), y.sum(1), m.sum(1), (y * y).sum(1), (m * m).sum(1), (y * m).sum(1)], axis=1)
    expected = [
        minimize_scalar(lambda g, a=a, b=b: ((a - g * b) ** 2).mean(), bounds=GAIN_RANGE, method="bounded").fun
        for a, b in zip(y, m, strict=True)
    ]
    np.testing.assert_allclose(mean_square_residual(moments), expected, rtol=1e-4)
    np.testing.assert_allclose(best_gain(moments, (0.01, 100.0)), (y * m).sum(1) / (m * m).sum(1))


def test_the_best_gain_of_a_slice_where_the_volume_is_empty_is_the_lowest() -> None:
    assert best_gain(np.array([10.0, 5, 0, 4, 0, 0]), (0.05, 20.0)) == 0.05


def test_the_residual_of_an_empty_model_is_the_image_and_never_negative() -> None:
    moments = np.array([[10.0, 5, 0, 4, 0, 0], [10, 5, 5, 4, 4, 4 + 1e-13], [0, 0, 0, 0, 0, 0]])
    np.testing.assert_allclose(mean_square_residual(moments), [0.4, 0, 0], atol=1e-12)
    assert (mean_square_residual(moments) >= 0).all()
