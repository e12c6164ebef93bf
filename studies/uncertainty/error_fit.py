"""The fit of the error model by maximum likelihood, and the file of its coefficients that ships with the package."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from g3r.uncertainty.error_model import ErrorModel

RIDGE = 1e-4
"""Weight of the ridge penalty, which keeps coefficients finite that a small sample does not determine."""

MIN_COEFFICIENT = {"log residual": 0.3}
"""Lower bounds of coefficients; the others are held at zero or above. Few subjects of a calibration have wrong poses,
and a model that learnt from the rest to ignore the residual would not notice a bad registration."""


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
