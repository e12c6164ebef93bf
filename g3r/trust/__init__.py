"""How far a result can be trusted, voxel by voxel: the expected size of the error, calibrated on simulations."""

from g3r.trust.uncertainty import Uncertainty, estimate_uncertainty

__all__ = ["Uncertainty", "estimate_uncertainty"]
