"""The expected absolute error as a product of powers of predictors; `studies/uncertainty/error_fit.py` fits it."""

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


def load_calibration(path: Path) -> tuple[dict[str, ErrorModel], dict[str, Any]]:
    """Models by name, and what each was fitted on."""
    record = json.loads(path.read_text(encoding="utf-8"))
    models = {
        name: ErrorModel(float(one["intercept"]), {k: float(v) for k, v in one["coefficients"].items()})
        for name, one in record.items()
    }
    return models, {name: one["fitted_on"] for name, one in record.items()}
