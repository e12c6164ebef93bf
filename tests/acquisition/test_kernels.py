"""Loops over pixels against scipy, in both precisions, for planes with more pixels than one run of the loop."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from g3r.acquisition.kernels import RUN
from g3r.acquisition.planes import Planes
from g3r.acquisition.voxel_operator import VoxelOperator
from tests.acquisition.test_voxel_operator import GRID, random_planes


def large_planes() -> Planes:
    """Planes that reach beyond the grid on all sides, the last one smaller than a run."""
    planes = random_planes(12, n=3)
    shape = np.array([[41, 37], [60, 30], [9, 11]])
    assert (shape.prod(1) > RUN).tolist() == [True, True, False]
    return Planes(
        rotation=planes.rotation,
        center_mm=planes.center_mm,
        spacing_mm=planes.spacing_mm,
        shape=shape,
        psf_var_mm2=planes.psf_var_mm2,
    )


@pytest.mark.parametrize(("dtype", "bound"), [(np.float64, 1e-12), (np.float32, 1e-4)])
def test_pixels_are_trilinear_readings_of_a_volume_in_zeros(dtype: type[np.floating], bound: float) -> None:
    """Single precision resolves pixel positions to 1e-6 voxel, and neighbouring values differ by up to ten."""
    planes = large_planes()
    volume = np.random.default_rng(1).normal(size=GRID.shape)
    found = VoxelOperator(planes, GRID, None, (1, 1, 1)).forward(volume.astype(dtype))
    index = GRID.index(planes.pixel_world_mm())
    expected = map_coordinates(volume, index.T, order=1, mode="grid-constant")
    assert (expected == 0).any()
    assert (expected != 0).any()
    np.testing.assert_allclose(found, expected, rtol=0, atol=bound)


def test_the_adjoint_holds_in_single_precision() -> None:
    planes = large_planes()
    operator = VoxelOperator(planes, GRID)
    rng = np.random.default_rng(2)
    volume = rng.normal(size=GRID.shape).astype(np.float32)
    pixels = rng.normal(size=planes.n_pixels).astype(np.float32)
    image, back = operator.forward(volume).astype(float), operator.adjoint(pixels).astype(float)
    assert abs(image @ pixels - (volume * back).sum()) <= 1e-5 * np.linalg.norm(image) * np.linalg.norm(pixels)


def test_pixels_in_any_order_are_where_they_are_in_order() -> None:
    planes = large_planes()
    every = planes.pixel_uv_mm()
    corner = (planes.shape[2] - 1) / 2 * planes.spacing_mm[2]
    np.testing.assert_allclose(every[-1], corner)
    np.testing.assert_allclose(every[planes.offset[2]], -corner)
    order = np.random.default_rng(3).permutation(planes.n_pixels)
    np.testing.assert_array_equal(planes.pixel_uv_mm(order), every[order])
    assert planes.pixel_uv_mm(order[:0]).shape == (0, 2)
