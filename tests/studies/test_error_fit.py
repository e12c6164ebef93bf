"""The fit of the error model: finds what is there, never falls as doubt grows, survives a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from g3r.uncertainty.error_model import ErrorModel, load_calibration
from studies.uncertainty.error_fit import MIN_COEFFICIENT, fit_model, save_calibration


def test_known_model_is_found_again() -> None:
    rng = np.random.default_rng(0)
    samples = {"a": rng.normal(size=40_000), "b": rng.uniform(0, 1, 40_000)}
    mean = np.exp(-3 + 0.5 * samples["a"] + 1.5 * samples["b"])
    found = fit_model(samples, rng.exponential(mean))
    # 40,000 exponential draws tell the coefficients to about 1 / sqrt(40,000)
    assert found.intercept == pytest.approx(-3, abs=0.03)
    assert found.coefficients["a"] == pytest.approx(0.5, abs=0.02)
    assert found.coefficients["b"] == pytest.approx(1.5, abs=0.05)


def test_the_mean_is_right_whatever_the_distribution() -> None:
    rng = np.random.default_rng(1)
    x = rng.normal(size=20_000)
    error = np.exp(-2 + 0.4 * x) * rng.choice([0.0, 4.0], 20_000, p=[0.75, 0.25]) * rng.choice([-1, 1], 20_000)
    found = fit_model({"x": x}, error)
    expected = np.exp(found.intercept + found.coefficients["x"] * x)
    assert expected.mean() == pytest.approx(np.abs(error).mean(), rel=0.02)


def test_weights_count_like_repetition() -> None:
    rng = np.random.default_rng(2)
    x, error = rng.normal(size=300), rng.exponential(0.1, 300)
    twice = np.r_[np.arange(300), np.arange(150)]
    weighted = fit_model({"x": x}, error, np.r_[np.full(150, 2.0), np.ones(150)])
    repeated = fit_model({"x": x[twice]}, error[twice])
    # the columns are scaled by their spread before the ridge, which repetition changes a little
    assert weighted.intercept == pytest.approx(repeated.intercept, abs=1e-3)


def test_coefficients_are_never_negative() -> None:
    rng = np.random.default_rng(3)
    x = rng.normal(size=5000)
    assert fit_model({"x": x}, rng.exponential(np.exp(-x))).coefficients["x"] == 0


def test_misfit_of_slices_always_counts() -> None:
    rng = np.random.default_rng(3)
    x = rng.normal(size=5000)
    found = fit_model({"log residual": x}, rng.exponential(np.exp(-x)))
    assert found.coefficients["log residual"] == pytest.approx(MIN_COEFFICIENT["log residual"])


def test_too_few_voxels() -> None:
    with pytest.raises(ValueError, match="expected more"):
        fit_model({"x": np.zeros(1)}, np.ones(1))


def test_file_keeps_the_model(tmp_path: Path) -> None:
    model = ErrorModel(-2.5, {"log residual": 0.25, "rim": 0.5})
    save_calibration(tmp_path / "c.json", {"a": model}, {"a": {"subjects": ["x"]}})
    assert load_calibration(tmp_path / "c.json") == ({"a": model}, {"a": {"subjects": ["x"]}})
