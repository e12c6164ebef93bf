"""The error model: recovers known coefficients, is monotonic in every predictor, survives a file."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.uncertainty.error_model import MAX_ERROR, MIN_ERROR, ErrorModel, load_calibration
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


def test_shipped_file_has_both() -> None:
    assert set(load_calibration(CALIBRATION)[0]) == {WITH_PRIOR, WITHOUT_PRIOR}
