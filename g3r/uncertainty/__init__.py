"""The expected error of each voxel, calibrated on simulations, and its prior share."""

from g3r.uncertainty.estimate import Uncertainty, UncertaintyInputs, estimate_uncertainty

__all__ = ["Uncertainty", "UncertaintyInputs", "estimate_uncertainty"]
