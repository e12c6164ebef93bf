"""The Density-Gated Prior Network (DGPN) of G3R Sec. 2.3."""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor, nn

from g3r.prior.config import PriorNetworkConfig
from g3r.prior.gate import DensityGate
from g3r.prior.inputs import PriorInputs
from g3r.prior.network import ResidualRefiner


class PriorOutput(NamedTuple):
    """V_prior, and the logit of each voxel being brain; both [B, 1, I, J, K]."""

    volume: Tensor
    brain_logit: Tensor


class DensityGatedPriorNetwork(nn.Module):
    """The structural prior: V_prior = base + G(c) F, Eq. 7 with a base that extends into unseen voxels.

    The paper's base is V_coarse, which is zero where nothing was measured. Here it is V_coarse where slices looked, and
    where none did an atlas template fitted to what they saw (`PriorInputs.base`). `use_sharp=False,
    use_template=False` is Eq. 7 as printed, except for the bound |F| < 1: alpha is the largest change of a densely
    measured voxel by the network, in units of the brightest tissue.

    The network holds the atlas template of its training; the caller fits it
    (`g3r.acquisition.template_fit`).

    Args:
        config: see `PriorNetworkConfig`.

    Raises:
        ValueError: from `DensityGate`.
    """

    template: Tensor

    def __init__(self, config: PriorNetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.gate = DensityGate(config.alpha, config.beta)
        self.refiner = ResidualRefiner(config)
        # for speed only: convolutions on a CPU take half the time with channels innermost
        self.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]
        self.register_buffer("template", torch.zeros(*config.template_shape))

    def set_template(self, volume: Tensor) -> None:
        """Set the atlas template [A, I, J, K], on a grid centred on the origin; no weight depends on its shape."""
        self.config = replace(self.config, template_shape=tuple(volume.shape))
        # rounded to float16 as in the file, so that training sees what inference sees
        self.template = volume.half().to(self.template)

    def forward(self, given: PriorInputs) -> PriorOutput:
        """Return V_prior in the units of V_coarse (G3R Eq. 7), and the brain's logit.

        Raises:
            ValueError: a volume that the network needs is missing.
        """
        residual, logit = self.refiner(given)
        if self.config.use_gate:
            residual = self.gate(given.read_density) * residual
        return PriorOutput(given.base(self.config) + residual, given.base_logit(self.config) + logit)
