"""How far a result can be trusted: the expected size of each voxel's error, calibrated on simulations."""

from g3r.uncertainty.estimate import Uncertainty, estimate_uncertainty

__all__ = ["Uncertainty", "estimate_uncertainty"]
