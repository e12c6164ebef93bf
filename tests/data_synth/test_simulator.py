"""The simulator against volumes whose slices are known in closed form, and against sampling at the true poses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.stats import rayleigh

from data_synth.atlas import TruthVolume
from data_synth.motion import LEVELS, MotionLevel
from data_synth.simulator import (
    SIGNAL_REACH_MM,
    SimulatedStack,
    StackSettings,
    orthogonal_settings,
    reach_voxels,
    simulate_stacks,
)
from data_synth.slice_profile import Profile
from g3r.acquisition.coarse_volume import coarse_and_density
from g3r.acquisition.psf import psf_variance_mm2
from g3r.acquisition.slicing import slices_from_stacks
from g3r.errors import InputError
from g3r.geometry import VolumeGrid

CLEAN = StackSettings(snr=np.inf, bias=0.0, gain_deviation=0.0)
N, VOXEL_MM = 56, 1.0
AFFINE = np.diag([VOXEL_MM, VOXEL_MM, VOXEL_MM, 1.0])
AFFINE[:3, 3] = [-20.0, -35.0, 10.0]  # no special origin
GRID = VolumeGrid((N, N, N), AFFINE)
WORLD = GRID.world(np.stack(np.meshgrid(*[np.arange(N)] * 3, indexing="ij"), -1))
BALL = np.linalg.norm(WORLD - GRID.center_mm, axis=-1) < 22
LEVEL = replace(LEVELS["moderate"], offset_mm=2.0)


def true_points_mm(one: SimulatedStack) -> np.ndarray:
    """True position of each pixel [I, J, K, 3]."""
    shape = one.stack.image.shape
    header = one.stack.grid.world(np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1))
    return one.true_pose.apply(header.transpose(2, 0, 1, 3)).transpose(1, 2, 0, 3)


def deep(one: SimulatedStack, radius_mm: float = 15.0) -> np.ndarray:
    """Pixels whose profile stays well inside the ball."""
    return np.linalg.norm(true_points_mm(one) - GRID.center_mm, axis=-1) < radius_mm


@pytest.mark.parametrize("profile", ["box", "gaussian", "sinc"])
def test_a_ramp_is_seen_as_it_is(profile: Profile) -> None:
    # a symmetric profile of unit integral does not change a linear function
    slope = np.array([3.0, -2.0, 5.0])
    volume = (500 + (WORLD - GRID.center_mm) @ slope).astype(np.float32)
    settings = [
        replace(CLEAN, orientation=o, motion=LEVEL, profile=profile, gap_mm=0.7, oblique_deg=8)
        for o in ("axial", "coronal", "sagittal", "random")
    ]
    for one in simulate_stacks(volume, BALL, AFFINE, settings, np.random.default_rng(0)):
        inside = deep(one)
        expected = 500 + (true_points_mm(one) - GRID.center_mm) @ slope
        assert inside.sum() > 1000
        np.testing.assert_allclose(one.stack.image[inside], expected[inside], atol=2e-3)


@pytest.mark.parametrize("profile", ["box", "gaussian", "sinc"])
@pytest.mark.parametrize("thickness_mm", [2.2, 4.0])
def test_a_blob_keeps_its_integral_and_widens_by_the_profile(profile: Profile, thickness_mm: float) -> None:
    sigma_mm = 4.5
    offset = WORLD - GRID.center_mm
    volume = (1000 * np.exp(-0.5 * (offset**2).sum(-1) / sigma_mm**2)).astype(np.float32)
    settings = replace(CLEAN, motion=LEVEL, profile=profile, thickness_mm=thickness_mm, resolution_mm=1.1)
    (one,) = simulate_stacks(volume, BALL, AFFINE, [settings], np.random.default_rng(1))
    variance = psf_variance_mm2([1.1, 1.1], thickness_mm)
    if profile != "gaussian":
        variance[:2] = 1.1**2 / 12
    if profile == "box":
        variance[2] = thickness_mm**2 * (1 + 0.2**2) / 12
    elif profile == "sinc":
        variance[2] = (0.287 * thickness_mm) ** 2
    observed = sigma_mm**2 + variance
    d = np.einsum("ijkw,kwf->ijkf", true_points_mm(one) - GRID.center_mm, one.true_pose.rotation)  # axial frame
    expected = 1000 * np.sqrt(sigma_mm**6 / observed.prod()) * np.exp(-0.5 * (d**2 / observed).sum(-1))
    inside = deep(one)
    # error of quadrature, of trilinear interpolation (whose blur varies within a voxel), and of the box's shape
    np.testing.assert_allclose(one.stack.image[inside], expected[inside], atol=8)
    assert abs(one.stack.image[inside].mean() / expected[inside].mean() - 1) < 2e-3


def smooth_volume(seed: int = 0) -> np.ndarray:
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=(N, N, N)), 4.0)
    return (500 + 150 * noise / noise.std()).astype(np.float32)


@pytest.mark.parametrize("fine", [False, True])
def test_sampling_the_truth_at_the_true_poses_gives_the_slices(fine: bool) -> None:
    volume = smooth_volume()
    settings = [
        replace(CLEAN, orientation=o, motion=LEVELS["severe"], thickness_mm=1.0, gap_mm=2.0, interleave=3)
        for o in ("axial", "sagittal")
    ]
    settings = [replace(s, motion=replace(s.motion, dropout_share=0.0)) for s in settings]
    for one in simulate_stacks(volume, BALL, AFFINE, settings, np.random.default_rng(2), fine=fine):
        inside = deep(one)
        expected = map_coordinates(volume, GRID.index(true_points_mm(one)[inside]).T, order=3)
        error = one.stack.image[inside] - expected
        assert np.sqrt((error**2).mean()) < 0.02 * expected.std()


def test_without_motion_the_header_is_the_truth() -> None:
    settings = orthogonal_settings(3, "none", gap_mm=0.5, snr=np.inf)
    for one in simulate_stacks(smooth_volume(), BALL, AFFINE, settings, np.random.default_rng(3)):
        np.testing.assert_array_equal(one.true_pose.rotation, np.broadcast_to(np.eye(3), one.true_pose.rotation.shape))
        np.testing.assert_allclose(one.true_pose.translation_mm, 0, atol=1e-12)
        np.testing.assert_allclose(one.stack.spacing_mm, [0.8, 0.8, 2.7])
        assert one.stack.thickness_mm == 2.2
        near = np.linalg.norm(true_points_mm(one) - GRID.center_mm, axis=-1)
        assert one.stack.mask[near < 20.5].all()
        assert not one.stack.mask[near > 23.5].any()


def test_orientations_and_handedness() -> None:
    settings = [replace(CLEAN, orientation=o) for o in ("axial", "coronal", "sagittal", "random")]
    stacks = simulate_stacks(smooth_volume(), BALL, AFFINE, settings, np.random.default_rng(4))
    for one, normal in zip(stacks, ([0, 0, 1], [0, -1, 0], [1, 0, 0], None), strict=True):
        axes = one.stack.affine[:3, :3] / one.stack.spacing_mm
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) > 0
        if normal is not None:
            np.testing.assert_allclose(axes[:, 2], normal, atol=1e-12)


def test_generator_decides_everything() -> None:
    def make(seed: int, n: int = 2) -> list[SimulatedStack]:
        state = np.random.get_state(legacy=False)["state"]["key"].copy()  # noqa: NPY002 - must not change
        settings = orthogonal_settings(n, "severe")
        stacks = simulate_stacks(smooth_volume(), BALL, AFFINE, settings, np.random.default_rng(seed))
        np.testing.assert_array_equal(state, np.random.get_state(legacy=False)["state"]["key"])  # noqa: NPY002
        return stacks

    first, again, other = make(5), make(5, 3), make(6)
    for a, b in zip(first, again, strict=False):  # a stack does not depend on the number of stacks after it
        np.testing.assert_array_equal(a.stack.image, b.stack.image)
        np.testing.assert_array_equal(a.true_pose.translation_mm, b.true_pose.translation_mm)
    assert np.abs(first[0].true_pose.translation_mm - other[0].true_pose.translation_mm).max() > 0.1


def test_noise_gain_and_dropout() -> None:
    volume = np.full((N, N, N), 500, np.float32)
    level = MotionLevel(dropout_share=0.3)
    noisy = StackSettings(motion=level, snr=20.0, bias=0.0, gain_deviation=0.1, gap_mm=0.0, thickness_mm=2.0)
    one, clean = (
        simulate_stacks(volume, BALL, AFFINE, [settings], np.random.default_rng(7))[0]
        for settings in (noisy, replace(noisy, snr=np.inf))
    )
    assert 1 <= one.dropout.sum() < len(one.dropout)
    assert (one.gain[one.dropout] < 0.7).all()
    inside = deep(one)
    for k in np.flatnonzero(inside.sum((0, 1)) > 200):
        values = one.stack.image[:, :, k][inside[:, :, k]]
        assert abs(values.mean() - 500 * one.gain[k]) < 4
        assert abs(values.std() - 500 / 40) < 2
    background = one.stack.image[clean.stack.image == 0]  # out of reach
    assert len(background) > 10_000
    expected = rayleigh(scale=500 / 40)
    assert background.mean() == pytest.approx(expected.mean(), rel=0.05)
    assert background.std() == pytest.approx(expected.std(), rel=0.05)


def log_bias_field(bias: float, resolution_mm: float) -> np.ndarray:
    """Coefficients of 1, x, y, xy, x^2 and y^2 (mm from the middle of the image) in the log of a constant's image."""
    settings = replace(CLEAN, bias=bias, resolution_mm=resolution_mm)
    volume = np.full((N, N, N), 500, np.float32)
    (one,) = simulate_stacks(volume, BALL, AFFINE, [settings], np.random.default_rng(9))
    shape = one.stack.image.shape
    x, y, _ = np.meshgrid(*[(np.arange(n) - (n - 1) / 2) * resolution_mm for n in shape], indexing="ij")
    inside = deep(one)
    log = np.log(one.stack.image / 500, where=inside, out=np.zeros(shape))
    by_slice = np.ma.masked_array(log, ~inside)
    assert by_slice.count(2).max() > 8
    assert np.ma.ptp(by_slice, axis=2).max() < 1e-5  # fixed to the scanner, so the same in every slice
    x, y, log = x[inside], y[inside], log[inside]
    terms = np.stack([np.ones_like(x), x, y, x * y, x**2, y**2], 1)
    coefficients = np.linalg.lstsq(terms, log, rcond=None)[0]
    np.testing.assert_allclose(terms @ coefficients, log, atol=1e-5)
    return coefficients


def test_the_bias_field_is_a_quadratic_in_mm() -> None:
    field = log_bias_field(0.3, 0.8)
    assert abs(field[0]) < 1e-5
    assert (np.abs(field[1:]) * [10, 10, 100, 100, 100] > 1e-3).all()
    np.testing.assert_allclose(log_bias_field(0.6, 0.8), 2 * field, rtol=1e-3, atol=1e-6)
    # the field is scaled by n / (n - 1) of n pixels, up to 3 % here
    np.testing.assert_allclose(log_bias_field(0.3, 1.6), field, rtol=0.06, atol=1e-6)


@pytest.mark.parametrize("thickness_mm", [2.2, 4.5])
def test_the_reach_is_a_length(thickness_mm: float) -> None:
    for stretch in (0.95, 1.0, 1.05):  # as in the studies' subjects, whose slices are cached
        assert reach_voxels(np.diag([0.8 * stretch, 0.8, 0.8, 1]), thickness_mm) == 4
    for voxel_mm in (0.3, 0.5, 1.0, 1.6, 2.5):
        reach_mm = reach_voxels(np.diag([voxel_mm] * 3 + [1.0]), thickness_mm) * voxel_mm
        profile_mm = 0.6 * thickness_mm
        assert max(SIGNAL_REACH_MM - voxel_mm / 2, profile_mm) <= reach_mm
        assert reach_mm < max(SIGNAL_REACH_MM + voxel_mm / 2, profile_mm + voxel_mm) + 1e-9
    assert reach_voxels(np.diag([0.5, 0.5, 0.5, 1]), 8.0) == 10  # 0.6 thicknesses, rounded up
    assert reach_voxels(np.diag([9.0, 9.0, 9.0, 1]), thickness_mm) == 1


@pytest.mark.parametrize("voxel_mm", [0.5, 1.0])
def test_thick_slices_show_the_head_as_far_as_their_profile_reaches(voxel_mm: float) -> None:
    n, thickness_mm = round(24 / voxel_mm), 8.0
    mask = np.zeros((n, n, n), bool)
    mask[(slice(n // 4, 3 * n // 4),) * 3] = True
    affine = np.diag([voxel_mm] * 3 + [1.0])
    settings = replace(CLEAN, thickness_mm=thickness_mm, gap_mm=-7.0, resolution_mm=1.0)
    volume = np.where(mask, 500, 0).astype(np.float32)
    (one,) = simulate_stacks(volume, mask, affine, [settings], np.random.default_rng(0))
    n_i, n_j, n_k = one.stack.image.shape
    depth_mm = one.stack.affine[2, 3] + np.arange(n_k) * 1.0
    # a box with soft edges through the slice, cut by a slab that ends half a voxel beyond its outer voxels
    low_mm, high_mm = (n // 4 - 0.5) * voxel_mm, (3 * n // 4 - 0.5) * voxel_mm
    at = np.linspace(-0.6, 0.6, 2401) * thickness_mm
    profile = np.clip((0.6 - np.abs(at) / thickness_mm) / 0.2, 0, 1)
    share = [profile[(at + z > low_mm) & (at + z < high_mm)].sum() / profile.sum() for z in depth_mm]
    assert ((np.array(share) > 0.02) & ((depth_mm < low_mm - 3) | (depth_mm > high_mm + 3))).any()
    np.testing.assert_allclose(one.stack.image[n_i // 2, n_j // 2], 500 * np.array(share), atol=10)  # quadrature


def test_bright_rim_outside_the_mask_is_not_needed() -> None:
    far = np.where(BALL, 500, 0).astype(np.float32)
    (one,) = simulate_stacks(far, BALL, AFFINE, [CLEAN], np.random.default_rng(8))
    assert one.stack.image[~one.stack.mask].min() == 0
    assert one.stack.image[deep(one)].min() > 499


@pytest.mark.parametrize(
    "wrong", [{"thickness_mm": 0.0}, {"resolution_mm": -1.0}, {"gap_mm": -2.1}, {"snr": 0.0}, {"bias": float("nan")}]
)
def test_impossible_settings(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="expected"):
        StackSettings(**wrong)  # type: ignore[arg-type]


def test_empty_mask_and_unknown_motion() -> None:
    with pytest.raises(InputError, match="mask is empty"):
        simulate_stacks(smooth_volume(), np.zeros_like(BALL), AFFINE, [CLEAN], np.random.default_rng(0))
    with pytest.raises(InputError, match="moderate"):
        orthogonal_settings(3, "wild")


def test_overlapping_slices_measure_more_than_once(head: TruthVolume) -> None:
    density = {}
    for gap_mm in (-1.5, 0.0, 1.5):
        settings = StackSettings(resolution_mm=1.5, thickness_mm=3.0, gap_mm=gap_mm)
        stacks = simulate_stacks(head.data, head.mask, head.affine, [settings], np.random.default_rng(0))
        slices = slices_from_stacks([stacks[0].stack])
        grid = VolumeGrid(head.data.shape, head.affine)
        density[gap_mm] = float(coarse_and_density(slices, grid)[1][head.mask].mean())
    assert density[0.0] == pytest.approx(1, abs=0.08)
    assert density[-1.5] == pytest.approx(2, abs=0.16)
    assert density[1.5] == pytest.approx(2 / 3, abs=0.08)
    with pytest.raises(InputError, match="gap"):
        StackSettings(thickness_mm=2.0, gap_mm=-2.0)
