"""The density-gated prior network and the pose network: layers, inference, and the files that carry them.

Names are looked up on first use: MONAI takes seconds to import, and a command that only parses its
arguments should not wait for it. The training side, which imports Lightning, is never imported here.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from g3r.prior.checkpoint import (
        PriorCheckpoint,
        load_prior,
        save_prior_checkpoint,
    )
    from g3r.prior.dgpn import DensityGatedPriorNetwork
    from g3r.prior.gate import DensityGate, confidence_from_density
    from g3r.prior.inference import estimate_prior
    from g3r.prior.network import ResidualRefiner
    from g3r.prior.pose_checkpoint import PoseCheckpoint, load_pose_network, save_pose_checkpoint
    from g3r.prior.pose_inference import predict_poses
    from g3r.prior.pose_network import PoseNetwork

__all__ = [
    "DensityGate",
    "DensityGatedPriorNetwork",
    "PoseCheckpoint",
    "PoseNetwork",
    "PriorCheckpoint",
    "ResidualRefiner",
    "confidence_from_density",
    "estimate_prior",
    "load_pose_network",
    "load_prior",
    "predict_poses",
    "save_pose_checkpoint",
    "save_prior_checkpoint",
]

_MODULE_OF = {
    "DensityGate": "gate",
    "DensityGatedPriorNetwork": "dgpn",
    "PoseCheckpoint": "pose_checkpoint",
    "PoseNetwork": "pose_network",
    "PriorCheckpoint": "checkpoint",
    "ResidualRefiner": "network",
    "confidence_from_density": "gate",
    "estimate_prior": "inference",
    "load_pose_network": "pose_checkpoint",
    "load_prior": "checkpoint",
    "predict_poses": "pose_inference",
    "save_pose_checkpoint": "pose_checkpoint",
    "save_prior_checkpoint": "checkpoint",
}


def __getattr__(name: str) -> Any:
    """Import the module that defines `name` when it is first asked for (PEP 562)."""
    if name in _MODULE_OF:
        return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
