"""The density-gated prior network: layers, whole-volume inference, and the checkpoint that carries it.

Names are looked up on first use: MONAI takes seconds to import, and a command that only parses its
arguments should not wait for it. The training side, `g3r.prior.lightning_module`, is never imported here.
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

__all__ = [
    "DensityGate",
    "DensityGatedPriorNetwork",
    "PriorCheckpoint",
    "ResidualRefiner",
    "confidence_from_density",
    "estimate_prior",
    "load_prior",
    "save_prior_checkpoint",
]

_MODULE_OF = {
    "DensityGate": "gate",
    "DensityGatedPriorNetwork": "dgpn",
    "PriorCheckpoint": "checkpoint",
    "ResidualRefiner": "network",
    "confidence_from_density": "gate",
    "estimate_prior": "inference",
    "load_prior": "checkpoint",
    "save_prior_checkpoint": "checkpoint",
}


def __getattr__(name: str) -> Any:
    """Import the module that defines `name` when it is first asked for (PEP 562)."""
    if name in _MODULE_OF:
        return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
