"""The expected absolute error as a product of powers of predictors, fitted by maximum likelihood."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.coverage import UNSEEN_POWER

DEPTH_MM = 3.0
"""Depth below the rim of the mask at which its influence has fallen to 1/e."""

FLOORS = {"residual": 0.005, "edge": 0.01, "texture": 0.005, "from_prior": 0.003, "unmeasured": 0.02}
"""Added before the logarithm: smaller differences of normalised intensities (or of 1 - c) carry no information."""

MIN_ERROR, MAX_ERROR = 1e-4, 1.0
"""Bounds of the expected error, in normalised intensities: a ten-thousandth of the brightest tissue, and all of it."""

RIDGE = 1e-4
"""Weight of the ridge penalty, which keeps coefficients finite that a small sample does not determine."""

MIN_COEFFICIENT = {"log residual": 0.3}
"""Lower bounds of coefficients; the others are held at zero or above. Few subjects of a calibration have wrong poses,
and a model that learnt from the rest to ignore the residual would not notice a bad registration."""


def terms(predictors: Mapping[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
    """Terms [n] of the logarithm of the expected error, by name; larger where the voxel is less certain."""
    found = {f"log {name}": np.log(predictors[name] + floor) for name, floor in FLOORS.items()}
    found["rim"] = np.exp(-predictors["depth_mm"] / DEPTH_MM)
    found["unseen"] = predictors["unmeasured"] ** UNSEEN_POWER
    if "prior_share" in predictors:
        found["prior_share"] = predictors["prior_share"]
    return found


@dataclass(frozen=True)
class ErrorModel:
    """ln u = intercept + sum of coefficient times term.

    Args:
        intercept: in the logarithm of normalised intensities.
        coefficients: of the terms by name; none is negative, so that a larger predictor never means a smaller error.
    """

    intercept: float
    coefficients: dict[str, float]

    def expected(self, predictors: Mapping[str, NDArray[np.float64]]) -> NDArray[np.float64]:
        """Expected absolute error u [n], in normalised intensities.

        Raises:
            ValueError: a predictor that the model was fitted with is missing.
        """
        found = terms(predictors)
        missing = sorted(set(self.coefficients) - set(found))
        if missing:
            raise ValueError(f"no predictor for {', '.join(missing)}")
        log_u = self.intercept + sum(b * found[name] for name, b in self.coefficients.items())
        with np.errstate(over="ignore"):  # infinity is clipped
            return np.clip(np.exp(np.asarray(log_u, dtype=np.float64)), MIN_ERROR, MAX_ERROR)


def fit_model(
    samples: Mapping[str, NDArray[np.float64]], error: NDArray[np.float64], weight: NDArray[np.float64] | None = None
) -> ErrorModel:
    """The model under which the errors are most likely, with an exponential distribution of mean u.

    Minimises the mean of ln u + |error| / u, which is convex in the coefficients and lowest where u is the
    mean absolute error, whatever the true distribution (a proper score of the mean). Coefficients are held
    at zero or above, or at what `MIN_COEFFICIENT` says.

    Args:
        samples: `terms` of n voxels.
        error: [n] volume minus truth.
        weight: [n] how much each voxel counts; all the same when None.

    Raises:
        ValueError: fewer voxels than coefficients.
    """
    names = list(samples)
    size = np.abs(error)
    if len(size) <= len(names):
        raise ValueError(f"{len(size)} voxels for {len(names) + 1} coefficients; expected more")
    columns = np.stack([samples[name] for name in names], axis=1)
    middle, spread = columns.mean(0), np.maximum(columns.std(0), 1e-6)
    design = np.c_[np.ones(len(size)), (columns - middle) / spread]
    share = np.full(len(size), 1 / len(size)) if weight is None else weight / weight.sum()

    def loss(b: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        log_u = np.clip(design @ b, -30, 30)
        ratio = size * np.exp(-log_u)
        value = share @ (log_u + ratio) + RIDGE * (b[1:] ** 2).sum()
        return float(value), design.T @ (share * (1 - ratio)) + 2 * RIDGE * np.r_[0, b[1:]]

    start = np.r_[np.log(max(float(share @ size), 1e-30)), np.zeros(len(names))]
    least = np.array([MIN_COEFFICIENT.get(name, 0.0) for name in names]) * spread
    start[1:] = least
    bounds = [(None, None), *[(float(bound), None) for bound in least]]
    from scipy.optimize import minimize  # the import takes a tenth of a second, and no reconstruction fits this model

    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds).x
    slopes = found[1:] / spread
    return ErrorModel(float(found[0] - slopes @ middle), {n: float(b) for n, b in zip(names, slopes, strict=True)})


def save_calibration(path: Path, models: Mapping[str, ErrorModel], fitted_on: Mapping[str, Any]) -> None:
    """Write models with what each was fitted on.

    Args:
        path: JSON file.
        models: by name.
        fitted_on: by the same names.
    """
    record = {
        name: {"intercept": m.intercept, "coefficients": m.coefficients, "fitted_on": fitted_on.get(name)}
        for name, m in models.items()
    }
    path.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def load_calibration(path: Path) -> tuple[dict[str, ErrorModel], dict[str, Any]]:
    """Models by name, and what each was fitted on."""
    record = json.loads(path.read_text(encoding="utf-8"))
    models = {
        name: ErrorModel(float(one["intercept"]), {k: float(v) for k, v in one["coefficients"].items()})
        for name, one in record.items()
    }
    return models, {name: one["fitted_on"] for name, one in record.items()}
