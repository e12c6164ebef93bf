"""Both stages on a scene of a few dozen Gaussians, and the reconstructor's invariances."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from g3r.acquisition.planes import volume_from_pixels, volume_planes
from g3r.fitting.fit_context import FitContext
from g3r.fitting.prior_stage import PriorStageSettings, VolumeTarget, fit_prior
from g3r.fitting.schedules import AnnealedWeight, prior_strength
from g3r.gaussians import GaussianCloud, render
from tests.fitting.scene import BALL, GRID, fit, make_slices, seeded, true_volume


@pytest.fixture(scope="module")
def volume() -> np.ndarray:
    return true_volume()


def volume_error(cloud: GaussianCloud, volume: np.ndarray) -> float:
    found = volume_from_pixels(render(cloud, volume_planes(GRID)).numpy(), GRID)
    return float(np.abs(found - volume)[BALL].mean())


def test_stage_1_comes_close_to_the_volume(volume: np.ndarray) -> None:
    target = VolumeTarget.of(volume, BALL.astype(np.float32), GRID)
    calls: list[tuple[int, int]] = []
    settings = PriorStageSettings(n_steps=30)
    progress = lambda done, total: calls.append((done, total))  # noqa: E731
    cloud, history = fit_prior(
        seeded(volume), target, settings, FitContext(rng=np.random.default_rng(0), progress=progress)
    )
    assert len(history) == 30
    assert np.mean(history[-5:]) < 0.75 * np.mean(history[:5])
    assert volume_error(cloud, volume) < 0.35 * volume_error(seeded(volume), volume)
    assert volume_error(cloud, volume) < 0.03 * volume[BALL].mean()
    assert calls[-1] == (30, 30)
    assert not any(p.requires_grad for p in cloud.parameters)


def test_stage_1_without_steps_still_solves_for_the_peaks(volume: np.ndarray) -> None:
    target = VolumeTarget.of(volume, BALL.astype(np.float32), GRID)
    cloud, history = fit_prior(
        seeded(volume), target, PriorStageSettings(n_steps=0), FitContext(rng=np.random.default_rng(0))
    )
    assert history == []
    assert volume_error(cloud, volume) < 0.6 * volume_error(seeded(volume), volume)


def test_a_volume_target_is_cropped_to_its_weight_and_taken_by_planes(volume: np.ndarray) -> None:
    target = VolumeTarget.of(volume, BALL.astype(np.float32), GRID)
    assert target.planes.n_pixels < volume.size
    assert target.weight.sum() == BALL.sum()
    world = target.planes.pixel_world_mm()
    nearest = np.rint(GRID.index(world)).astype(int)
    np.testing.assert_allclose(GRID.world(nearest), world, atol=1e-9)
    np.testing.assert_array_equal(target.value, volume[tuple(nearest.T)])
    part = target.take(np.array([3, 7]))
    size = int(target.planes.offset[1])
    np.testing.assert_array_equal(
        part.value, np.r_[target.value[3 * size : 4 * size], target.value[7 * size : 8 * size]]
    )
    np.testing.assert_array_equal(part.planes.center_mm, target.planes.center_mm[[3, 7]])
    with pytest.raises(ValueError, match="zero everywhere"):
        VolumeTarget.of(volume, 0 * volume, GRID)


def test_stage_2_lowers_the_loss_and_sharpens_the_volume(volume: np.ndarray) -> None:
    blurred, slices = 0.8 * volume + 0.1, make_slices()
    # without noise, slices would be weighted only by the jitter of the steps
    noise = np.random.default_rng(3).normal(0, 0.01, slices.value.shape).astype(np.float32)
    result = fit(blurred, replace(slices, value=slices.value + noise))
    image = [entry["image"] for entry in result.history]
    assert len(image) == 40
    assert np.mean(image[-5:]) < 0.6 * image[0]
    assert volume_error(result.cloud, volume) < 0.5 * volume_error(seeded(blurred), volume)
    assert "distillation" not in result.history[0]
    assert (result.weight > 0.3).all()  # no slice is discarded


def test_with_poses_off_no_slice_moves(volume: np.ndarray) -> None:
    slices = make_slices()
    result = fit(volume, slices, optimise_poses=False, n_steps=10)
    np.testing.assert_array_equal(result.slices.planes.rotation, slices.planes.rotation)
    np.testing.assert_array_equal(result.slices.planes.center_mm, slices.planes.center_mm)


def test_poses_that_are_right_hardly_move_and_wrong_ones_come_nearer(volume: np.ndarray) -> None:
    slices = make_slices()
    target = VolumeTarget.of(volume, BALL.astype(np.float32), GRID)
    right = fit(volume, slices, target)
    drift = np.linalg.norm(right.slices.planes.center_mm - slices.planes.center_mm, axis=1)
    assert np.median(drift) < 0.15
    center = slices.planes.center_mm.copy()
    shift = np.array([0.6, -0.5, 0.4])
    center[[3, 12]] += shift
    astray = replace(slices, planes=replace(slices.planes, center_mm=center))
    found = fit(volume, astray, target, n_steps=60)
    left = np.linalg.norm(found.slices.planes.center_mm - slices.planes.center_mm, axis=1)[[3, 12]]
    assert (left < 0.7 * np.linalg.norm(shift)).all()


def test_gains_are_recovered(volume: np.ndarray) -> None:
    log_gain = np.random.default_rng(1).normal(0, 0.08, 24)
    gain = np.exp(log_gain - log_gain.mean())
    result = fit(volume, make_slices(gain), n_steps=80, optimise_poses=False)
    inner = np.tile((np.arange(8) > 0) & (np.arange(8) < 7), 3)
    before, after = np.abs(np.log(gain))[inner], np.abs(np.log(result.gain / gain))[inner]
    assert after.mean() < 0.5 * before.mean()
    assert np.log(result.gain).mean() == pytest.approx(0, abs=1e-5)


def test_a_single_slice_keeps_its_gain(volume: np.ndarray) -> None:
    slices = make_slices().take([3])
    result = fit(volume, slices, gain=np.array([1.3]), n_steps=5)
    assert result.gain[0] == pytest.approx(1.3, rel=1e-6)


def test_distillation_fades_and_holds_what_no_slice_sees(volume: np.ndarray) -> None:
    slices = make_slices().take(np.arange(3, 5))  # two slices through the middle of one stack
    target = VolumeTarget.of(volume, BALL.astype(np.float32), GRID)
    options: dict[str, Any] = {"n_steps": 30, "optimise_poses": False}
    held = fit(volume, slices, target, distillation=AnnealedWeight(1.0, 0.2), **options)
    weights = [entry["distillation_weight"] for entry in held.history]
    assert weights[0] == 1.0
    assert weights[-1] == pytest.approx(0.2)
    free = fit(volume, slices, None, **options)
    assert volume_error(held.cloud, volume) < volume_error(free.cloud, volume)
    off = fit(volume, slices, target, distillation=AnnealedWeight(0.0, 0.0), **options)
    assert "distillation" not in off.history[0]
    torch.testing.assert_close(off.cloud.amplitude, free.cloud.amplitude)


def test_a_spoilt_slice_is_down_weighted(volume: np.ndarray) -> None:
    slices = make_slices()
    bad = slices.planes.plane_id() == 4
    value = slices.value.copy()
    value[bad] = value[bad][::-1] * 0.3 + np.random.default_rng(2).normal(0, 0.5, bad.sum()).astype(np.float32)
    result = fit(volume, replace(slices, value=value), n_steps=45)
    assert result.weight[4] < 0.3
    assert np.delete(result.weight, 4).min() > 0.5


def test_the_same_seed_gives_the_same_fit(volume: np.ndarray) -> None:
    target = VolumeTarget.of(volume, BALL.astype(np.float32), GRID)
    one, two = (fit(volume, make_slices(), target, n_steps=12) for _ in range(2))
    torch.testing.assert_close(one.cloud.mean_mm, two.cloud.mean_mm, rtol=0, atol=0)
    assert one.history == two.history


def test_the_prior_weighs_by_the_residual_over_its_error_and_never_more_than_a_pixel() -> None:
    schedule = AnnealedWeight(0.5, 0.05)
    assert prior_strength(schedule, 0.05, 0.0, 0.001) == 0.5
    assert prior_strength(schedule, 0.05, 1.0, 0.001) == pytest.approx(0.05)
    assert prior_strength(schedule, 0.05, 1.0, 0.02) == pytest.approx(0.4)
    assert prior_strength(schedule, 0.025, 1.0, 0.02) == pytest.approx(0.8)
    assert prior_strength(schedule, 0.05, 1.0, 0.5) == 1.0
    assert prior_strength(schedule, 0.0, 1.0, 0.5) == pytest.approx(0.05)
    assert prior_strength(AnnealedWeight(0.0, 0.0), 0.05, 0.5, 0.5) == 0.0
