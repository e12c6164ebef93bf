"""The Density-Gated Prior Network (DGPN) of G3R Sec. 2.3."""

import torch
from torch import Tensor, nn

from g3r.prior.config import PriorNetworkConfig
from g3r.prior.gate import DensityGate
from g3r.prior.network import ResidualRefiner


class DensityGatedPriorNetwork(nn.Module):
    """The structural prior: V_prior = V_coarse + G(c) F(V_coarse, V_sharp, M_rho), Eq. 7 with one more input.

    `use_sharp=False` is Eq. 7 as printed, F(V_coarse, M_rho). V_sharp is what the slices determine by
    themselves (`sharpened_volume`): F need not learn to invert the slice profile (docs/prior.md).

    With the paper's alpha = 0.05 and beta = 1 the gate passes the whole residual at zero density, 10 % of
    it under three gapless stacks (M = 3) and 5 % at high density. The shipped network was trained on hardly any
    unmeasured voxels and adds little there.

    Args:
        config: see `PriorNetworkConfig`.

    Raises:
        ValueError: from `DensityGate`.
    """

    def __init__(self, config: PriorNetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.gate = DensityGate(config.alpha, config.beta)
        self.refiner = ResidualRefiner(config)
        # only for speed: convolutions on a CPU take half the time with channels innermost
        self.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]

    def forward(self, v_coarse: Tensor, m_rho: Tensor, v_sharp: Tensor | None = None) -> Tensor:
        """Return V_prior (G3R Eq. 7).

        Args:
            v_coarse: [B, 1, I, J, K], normalised so that its 99th percentile in the support is 1.
            m_rho: [B, 1, I, J, K], dimensionless density M >= 0.
            v_sharp: [B, 1, I, J, K], on V_coarse's scale; see `sharpened_volume`. Only with `use_sharp`.

        Returns:
            V_prior, [B, 1, I, J, K], in the units of `v_coarse`.

        Raises:
            ValueError: `use_sharp` without V_sharp.
        """
        residual = self.refiner(v_coarse, m_rho, v_sharp)
        base = v_sharp if self.config.sharp_base else v_coarse
        assert base is not None  # the refiner has refused it
        return base + (self.gate(m_rho) * residual if self.config.use_gate else residual)
