"""M_rho is 1 in one gapless stack, V_coarse is a weighted mean, and small confidences keep their precision."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g3r.acquisition.coarse_volume import coarse_and_density, confidence, normalisation_scale
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack
from g3r.errors import InputError
from g3r.geometry import VolumeGrid

SIZE_MM = 40.0
TURNS = {
    "axial": np.eye(3),
    "coronal": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "sagittal": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
}


def cube_stack(
    pixel_mm: float = 1.0,
    thickness_mm: float = 3.0,
    slice_spacing_mm: float | None = None,
    turn: np.ndarray = TURNS["axial"],
    value: float | None = 7.0,
) -> Stack:
    """A stack whose mask is a cube of 40 mm about the origin."""
    spacing = np.array([pixel_mm, pixel_mm, slice_spacing_mm or thickness_mm])
    shape = tuple(np.rint(SIZE_MM / spacing).astype(int))
    affine = np.eye(4)
    affine[:3, :3] = turn * spacing
    affine[:3, 3] = -affine[:3, :3] @ ((np.array(shape) - 1) / 2)
    image = np.full(shape, value or 1.0, np.float32)
    image[0, 0, 0] += 1e-3 * image[0, 0, 0]  # a stack that is constant throughout is refused
    return Stack(image=image, mask=np.ones(shape, bool), affine=affine, thickness_mm=thickness_mm)


def density_inside(slices: Slices, voxel_mm: float = 1.0, **options: Any) -> np.ndarray:
    """M over the inner cube of 24 mm, which holds whole periods of every slice spacing in use."""
    grid = VolumeGrid.isotropic([-12 + voxel_mm / 2] * 3, [12 - voxel_mm / 2] * 3, voxel_mm)
    return coarse_and_density(slices, grid, **options)[1]


@pytest.mark.parametrize("turn", TURNS)
def test_one_gapless_stack_counts_once(turn: str) -> None:
    density = density_inside(slices_from_stacks([cube_stack(turn=TURNS[turn])]))
    assert density.mean() == pytest.approx(1, abs=0.01)
    # slices with FWHM = spacing ripple by 2 exp(-2 pi^2 / 2.3548^2) = 5.7 %
    assert density.min() > 0.93
    assert density.max() < 1.07


@pytest.mark.parametrize("pixel_mm", [0.5, 0.8, 1.6])
@pytest.mark.parametrize("thickness_mm", [2.0, 4.0])
def test_density_depends_neither_on_pixel_size_nor_thickness(pixel_mm: float, thickness_mm: float) -> None:
    density = density_inside(slices_from_stacks([cube_stack(pixel_mm, thickness_mm)]))
    assert density.mean() == pytest.approx(1, abs=0.015)


@pytest.mark.parametrize("voxel_mm", [0.6, 1.5, 3.0])
def test_density_does_not_depend_on_the_grid(voxel_mm: float) -> None:
    density = density_inside(slices_from_stacks([cube_stack()]), voxel_mm)
    assert density.mean() == pytest.approx(1, abs=0.015)
    assert density.min() > 0.88


def test_an_oblique_grid_sees_the_same_density() -> None:
    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_rotvec([0.5, -0.3, 0.8]).as_matrix() * [-1.0, 1, 1]
    affine[:3, 3] = -affine[:3, :3] @ np.full(3, 7.5)
    _, density = coarse_and_density(slices_from_stacks([cube_stack()]), VolumeGrid((16, 16, 16), affine))
    assert density.mean() == pytest.approx(1, abs=0.015)


def test_three_stacks_count_thrice() -> None:
    stacks = [cube_stack(turn=turn) for turn in TURNS.values()]
    density = density_inside(slices_from_stacks(stacks))
    assert density.mean() == pytest.approx(3, abs=0.03)
    assert confidence(density).mean() == pytest.approx(0.95, abs=0.003)


def test_a_gap_lowers_the_density_to_thickness_over_distance() -> None:
    density = density_inside(slices_from_stacks([cube_stack(thickness_mm=2.0, slice_spacing_mm=4.0)]))
    assert density.mean() == pytest.approx(0.5, abs=0.01)
    assert density.min() < 0.35  # in the gaps
    assert density.max() > 0.65


def test_weight_lowers_density_but_not_the_mean() -> None:
    slices = slices_from_stacks([cube_stack()])
    grid = VolumeGrid.isotropic([-10] * 3, [10] * 3, 1.0)
    full = coarse_and_density(slices, grid)
    quarter = coarse_and_density(slices, grid, weight=np.full(len(slices.pixel_index), 0.25, np.float32))
    np.testing.assert_allclose(quarter[1], 0.25 * full[1], rtol=1e-5)
    np.testing.assert_allclose(quarter[0], full[0], rtol=1e-5)


def test_weight_zero_leaves_pixels_out() -> None:
    stacks = [cube_stack(value=7.0), cube_stack(value=9000.0)]
    slices = slices_from_stacks(stacks)
    weight = (slices.stack_id[slices.pixel_plane] == 0).astype(np.float32)
    coarse, density = coarse_and_density(slices, VolumeGrid.isotropic([-10] * 3, [10] * 3, 1.0), weight=weight)
    np.testing.assert_allclose(coarse, 7, rtol=1e-4)
    assert density.mean() == pytest.approx(1, abs=0.02)


def test_a_constant_comes_out_constant_and_nothing_where_nothing_was_seen() -> None:
    slices = slices_from_stacks([cube_stack(thickness_mm=2.0, slice_spacing_mm=5.0)])
    coarse, density = coarse_and_density(slices, VolumeGrid.isotropic([-40] * 3, [40] * 3, 2.0))
    seen = density > 1e-3
    assert 0.1 < seen.mean() < 0.4
    np.testing.assert_allclose(coarse[seen], 7, rtol=1.1e-3)  # one pixel differs by 1e-3
    assert (coarse[~seen] == 0).all()
    assert (density >= 0).all()
    assert coarse.dtype == density.dtype == np.float32


def test_gains_are_divided_out() -> None:
    slices = slices_from_stacks([cube_stack()])
    gain = np.random.default_rng(0).uniform(0.5, 2, len(slices))
    dark = Slices(
        planes=slices.planes,
        value=(slices.value * np.repeat(gain, np.diff(slices.planes.offset))).astype(np.float32),
        mask=slices.mask,
        stack_id=slices.stack_id,
        slice_index=slices.slice_index,
        thickness_mm=slices.thickness_mm,
        header_pose=slices.header_pose,
    )
    grid = VolumeGrid.isotropic([-10] * 3, [10] * 3, 1.0)
    np.testing.assert_allclose(coarse_and_density(dark, grid, gain)[0], 7, rtol=2e-3)
    np.testing.assert_allclose(coarse_and_density(dark, grid, gain)[1], coarse_and_density(slices, grid)[1])


def test_confidence_at_its_ends() -> None:
    density = np.array([0.0, 1e-30, 1e-8, 1.0, 3.0, 1e6])
    found = confidence(density)
    assert found[0] == 0
    assert found[1] == 1e-30  # 1 - exp(-M) would be zero in floating point
    assert found[2] == pytest.approx(1e-8, rel=1e-8)
    np.testing.assert_allclose(found[3:5], [0.63212, 0.95021], atol=1e-5)
    assert found[5] == 1
    single = confidence(density.astype(np.float32))
    assert single.dtype == np.float32
    assert single[1] == np.float32(1e-30)
    assert (np.diff(single) >= 0).all()


def test_normalisation_scale_is_the_99th_percentile_of_what_was_seen() -> None:
    rng = np.random.default_rng(1)
    coarse, density = rng.uniform(0, 100, (20, 20, 20)), rng.uniform(0, 0.2, (20, 20, 20))
    coarse[density < 0.1] = 1e9
    scale = normalisation_scale(coarse, density)
    assert scale == np.percentile(coarse[density > 0.1], 99)
    assert normalisation_scale(coarse * 1e-6, density) == pytest.approx(scale * 1e-6)


@pytest.mark.parametrize(
    ("coarse", "density", "message"),
    [
        (np.ones(5), np.zeros(5), "no voxel is covered"),
        (np.zeros(5), np.ones(5), "positive"),
        (-np.ones(5), np.ones(5), "-1"),
    ],
)
def test_normalisation_scale_refuses(coarse: np.ndarray, density: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        normalisation_scale(coarse, density)
