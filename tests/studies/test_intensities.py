"""The study of gains and fields against the truth: its error measure and its table."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from g3r.acquisition.images import Volume
from g3r.acquisition.slicing import slices_from_stacks
from g3r.bench.record import machine
from g3r.evaluation.case import load_case
from g3r.evaluation.pose_error import PoseTable
from g3r.geometry import RigidPose
from studies.tradeoff import intensities
from studies.tradeoff.intensities import ExpectedPixels, shading

N_SLICES, N_PIXELS = 20, 400


def _expected_and_gains() -> tuple[ExpectedPixels, np.ndarray[Any, Any]]:
    rng = np.random.default_rng(1)
    plane = np.repeat(np.arange(N_SLICES), N_PIXELS)
    expected = ExpectedPixels(
        index=np.arange(len(plane)),
        plane=plane,
        value=rng.uniform(0.5, 1.5, len(plane)),
        uv=rng.uniform(-1, 1, (len(plane), 2)),
    )
    return expected, np.exp(rng.normal(0, 0.05, N_SLICES))


def _poses(value: np.ndarray[Any, Any], gain: np.ndarray[Any, Any]) -> Any:
    return SimpleNamespace(slices=SimpleNamespace(value=value), gain=gain)


def test_true_gains_have_no_error_whatever_the_common_factor() -> None:
    expected, gain = _expected_and_gains()
    assert expected.error(_poses(3 * gain[expected.plane] * expected.value, gain)) == pytest.approx(0, abs=1e-4)


def test_gains_that_were_not_found_and_fields_that_were_not_divided_out_are_the_error() -> None:
    expected, gain = _expected_and_gains()
    measured = gain[expected.plane] * expected.value
    found = expected.error(_poses(measured, np.ones(N_SLICES)))
    assert found == pytest.approx(np.log(gain).std(), rel=0.02)
    shaded = expected.error(_poses(measured * np.exp(0.1 * expected.uv[:, 0]), gain))
    assert shaded == pytest.approx(0.1 / np.sqrt(3), rel=0.05)


def test_noise_is_no_error_of_gains() -> None:
    expected, gain = _expected_and_gains()
    noisy = (
        gain[expected.plane] * expected.value * np.exp(np.random.default_rng(2).normal(0, 0.05, len(expected.plane)))
    )
    assert expected.error(_poses(noisy, gain)) < 0.006


def test_expected_pixels_are_those_of_the_true_poses(subject: Path) -> None:
    case = load_case(subject, 4.0)
    slices = slices_from_stacks(case.stacks)
    expected = ExpectedPixels.of(case, slices, 0)
    right = np.corrcoef(expected.value, slices.value[expected.index])[0, 1]
    assert right > 0.88
    np.testing.assert_array_equal(slices.planes.plane_id()[expected.index], expected.plane)
    shifted = RigidPose(case.true.pose.rotation, case.true.pose.translation_mm + 5.0)
    moved = ExpectedPixels.of(replace(case, true=PoseTable(case.true.keys, shifted)), slices, 0)
    assert np.corrcoef(moved.value, slices.value[moved.index])[0, 1] < right - 0.2


def test_shading_is_the_smooth_factor_between_a_volume_and_the_truth() -> None:
    shape = (40, 40, 40)
    rng = np.random.default_rng(0)
    truth = Volume(rng.uniform(0.5, 1.0, shape).astype(np.float32), np.diag([2.0, 2.0, 2.0, 1.0]), "truth")
    inside = np.ones(shape, bool)
    assert shading(3 * truth.data, truth, inside) < 1e-6  # a common factor is no shading
    slope = np.linspace(-0.1, 0.1, 40)[:, None, None]
    found = shading(truth.data * np.exp(slope), truth, inside)
    assert 0.7 * slope.std() < found < slope.std()  # blurred, so a little less
    noisy = truth.data * rng.uniform(0.95, 1.05, shape)
    assert shading(noisy, truth, inside) < 0.1 * slope.std()


def test_the_table_has_both_errors_and_both_volumes() -> None:
    row = {
        "case": "one",
        "masks": "with a rim",
        "n_stacks": 3,
        "registered": {"error": 0.034, "inner_psnr_db": 30.0, "shading": 0.021},
        "matched": {"error": 0.019, "inner_psnr_db": 31.5, "shading": 0.007},
        "without_n4": {"error": 0.019, "inner_psnr_db": 30.9, "shading": 0.0147},
    }
    record = {"preset": "balanced", "weights": "ab", "machine": machine(), "rows": {"one, with a rim": row}}
    found = intensities.tables(record)["intensities"]
    assert "| one | with a rim | 3 | 3.4% | 1.9% | 30.00 | 31.50 | 30.90 | 0.70% | 1.47% |" in found
    assert "31.50 dB" in intensities.line("one", row)
