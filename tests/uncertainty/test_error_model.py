"""The error model: recovers known coefficients, is monotonic in every predictor, survives a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from g3r.uncertainty.error_model import (
    MAX_ERROR,
    MIN_COEFFICIENT,
    MIN_ERROR,
    ErrorModel,
    fit_model,
    load_calibration,
    save_calibration,
    terms,
)
from g3r.uncertainty.estimate import CALIBRATION, WITH_PRIOR, WITHOUT_PRIOR, calibration


def predictors(n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Predictors over the range of real reconstructions."""
    return {
        "unmeasured": rng.uniform(0, 1, n),
        "from_prior": rng.exponential(0.02, n),
        "edge": rng.exponential(0.05, n),
        "texture": rng.exponential(0.03, n),
        "residual": 0.01 + rng.exponential(0.02, n),
        "depth_mm": rng.uniform(0.4, 30, n),
        "prior_share": rng.uniform(0, 1, n),
    }


def test_known_model_is_found_again() -> None:
    rng = np.random.default_rng(0)
    samples = {"a": rng.normal(size=40_000), "b": rng.uniform(0, 1, 40_000)}
    mean = np.exp(-3 + 0.5 * samples["a"] + 1.5 * samples["b"])
    found = fit_model(samples, rng.exponential(mean))
    # 40,000 exponential draws determine the coefficients to about 1 / sqrt(40,000)
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
    # the columns are scaled by their spread before the ridge, and repetition changes the spread slightly
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


@pytest.mark.parametrize("name", [WITH_PRIOR, WITHOUT_PRIOR])
def test_shipped_calibration_grows_with_every_doubt(name: str) -> None:
    model, known = calibration()[name], predictors(500, np.random.default_rng(4))
    before = model.expected(known)
    assert np.isfinite(before).all()
    assert before.min() >= MIN_ERROR
    assert before.max() <= MAX_ERROR
    for what in known:
        more = dict(known)
        more[what] = known[what] - 0.2 if what == "depth_mm" else known[what] * 1.2
        assert (model.expected(more) >= before * (1 - 1e-12)).all(), what
    assert model.coefficients, "a calibration of nothing"


def test_less_density_is_more_uncertain() -> None:
    model, known = calibration()[WITH_PRIOR], predictors(500, np.random.default_rng(5))
    sparse, dense = {**known, "unmeasured": np.full(500, 0.37)}, {**known, "unmeasured": np.full(500, 0.05)}
    more, less = model.expected(sparse), model.expected(dense)
    assert (more >= less).all()
    assert (more > less)[less < MAX_ERROR].all()
    assert (less < MAX_ERROR).mean() > 0.5


def test_extremes_stay_finite() -> None:
    for size in (0.0, 1e-30, 1e6):
        known = {name: np.full(3, size) for name in predictors(1, np.random.default_rng(6))}
        for model in calibration().values():
            u = model.expected(known)
            assert np.isfinite(u).all()
            assert ((u >= MIN_ERROR) & (u <= MAX_ERROR)).all()


def test_missing_evidence_is_named() -> None:
    known = predictors(5, np.random.default_rng(7))
    del known["prior_share"]
    with pytest.raises(ValueError, match="prior_share"):
        ErrorModel(0.0, {"prior_share": 1.0}).expected(known)


def test_file_keeps_the_model(tmp_path: Path) -> None:
    model = ErrorModel(-2.5, dict.fromkeys(terms(predictors(5, np.random.default_rng(8))), 0.25))
    save_calibration(tmp_path / "c.json", {"a": model}, {"a": {"subjects": ["x"]}})
    assert load_calibration(tmp_path / "c.json") == ({"a": model}, {"a": {"subjects": ["x"]}})


def test_shipped_file_has_both() -> None:
    assert set(load_calibration(CALIBRATION)[0]) == {WITH_PRIOR, WITHOUT_PRIOR}
