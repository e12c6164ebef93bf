"""uncertainty.nii.gz: the expected absolute error of each voxel of the volume."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.fitting.slice_stage import SliceFit
from g3r.gaussians.render import CUTOFF_SIGMA
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import on_grid
from g3r.uncertainty.error_model import ErrorModel, load_calibration
from g3r.uncertainty.predictors import gather_predictors, mean_residual

CALIBRATION = Path(__file__).parent / "calibration.json"

WITH_PRIOR, WITHOUT_PRIOR = "with prior", "without prior"
"""Names of the two calibrations: for reconstructions that used a prior, and for those that did not."""

MEANING = "expected absolute error of volume.nii.gz, in its intensity units"

MOSTLY_PRIOR = 0.5
"""A voxel whose prior share is larger shows more of the prior than of the slices."""

UNRELIABLE_NOTE = "registration is unreliable: the uncertainty is calibrated on registered stacks and too small here"
UNCHECKED_NOTE = "a single stack: nothing but the prior checks its poses"


@dataclass(frozen=True)
class Uncertainty:
    """The map and its entry of run.json.

    Attributes:
        expected_error: [I, J, K] in the volume's intensities; zero outside the mask.
        record: median and 90th percentile in the mask, units, calibration, whether the registration is reliable.
    """

    expected_error: NDArray[np.float32]
    record: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class UncertaintyInputs:
    """Properties of a result that are known without the truth, in normalised intensities.

    Attributes:
        volume: [I, J, K].
        mask: [I, J, K].
        grid: of both.
        fit: Gaussians and slices as the fit left them.
        prior: on `prior_grid`; what the fit started from where no network was used.
        density: M_rho on `prior_grid`.
        prior_grid: of these two.
        prior_share: [I, J, K] on `grid`; None where no network was used.
        cutoff_sigma: where the fit's Gaussians end.
    """

    volume: NDArray[np.float32]
    mask: NDArray[np.bool_]
    grid: VolumeGrid
    fit: SliceFit
    prior: NDArray[np.float32]
    density: NDArray[np.float32]
    prior_grid: VolumeGrid
    prior_share: NDArray[np.float32] | None = None
    cutoff_sigma: float = CUTOFF_SIGMA

    def predictors(self) -> dict[str, NDArray[np.float64]]:
        """The predictors on the voxels of the mask; see `gather_predictors`."""
        return gather_predictors(
            self.volume,
            self.mask,
            self.grid,
            residual=mean_residual(self.fit, self.grid, self.cutoff_sigma),
            density=on_grid(self.density, self.prior_grid, self.grid, outside=0.0),
            prior=on_grid(self.prior, self.prior_grid, self.grid, outside=0.0),
            prior_share=self.prior_share,
        )


def estimate_uncertainty(
    given: UncertaintyInputs, *, with_prior: bool = True, intensity: float = 1.0, reliable: bool | None = True
) -> Uncertainty:
    """The expected absolute error of every voxel of the mask.

    The model is a product of powers of predictors, with coefficients fitted to simulated subjects
    (`python -m studies.uncertainty.calibration fit`). It gives a mean over voxels that look alike to the pipeline, not
    a bound: errors of single voxels scatter around it about as an exponential distribution does.

    Args:
        given: the result.
        with_prior: whether a prior network was used: there is a calibration for each.
        intensity: intensity in the files that is 1 in the fit; the map is multiplied by it.
        reliable: whether the registration is reliable; None where nothing checks it.
    """
    name = WITH_PRIOR if with_prior else WITHOUT_PRIOR
    error = calibration()[name].expected(given.predictors())
    expected = np.zeros(given.mask.shape, np.float32)
    expected[given.mask] = error * intensity
    record: dict[str, Any] = {
        "meaning": MEANING,
        "median_in_mask": float(np.median(error)) * intensity,
        "p90_in_mask": float(np.percentile(error, 90)) * intensity,
        "median_over_brightest": float(np.median(error)),
        "calibration": name,
        "registration_reliable": reliable,
    }
    if reliable is not True:
        record["note"] = UNCHECKED_NOTE if reliable is None else UNRELIABLE_NOTE
    if given.prior_share is not None:
        record["prior_share"] = prior_share_summary(given.prior_share[given.mask])
    return Uncertainty(expected, record)


def prior_share_summary(share: NDArray[np.float32]) -> dict[str, float]:
    """Mean prior share of the voxels in the mask [n], and the share of voxels that show mostly the prior."""
    if not share.size:
        return {"mean_in_mask": 0.0, "mask_mostly_prior": 0.0}
    return {"mean_in_mask": float(share.mean()), "mask_mostly_prior": float((share > MOSTLY_PRIOR).mean())}


@cache
def calibration() -> dict[str, ErrorModel]:
    """The models that ship with the package."""
    return load_calibration(CALIBRATION)[0]
