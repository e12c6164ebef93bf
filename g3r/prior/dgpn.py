"""The Density-Gated Prior Network (DGPN) of G3R Sec. 2.3."""

from collections.abc import Sequence
from typing import Any

from torch import Tensor, nn

from g3r.prior.gate import DensityGate
from g3r.prior.network import ResidualRefiner


class DensityGatedPriorNetwork(nn.Module):
    """The structural prior: V_prior = V_coarse + G(c) F(V_coarse, V_sharp, M_rho), Eq. 7 with one more input.

    `use_sharp=False` is Eq. 7 as printed, F(V_coarse, M_rho). V_sharp is what the slices determine by
    themselves (`sharpened_volume`): F need not learn to invert the slice profile (docs/prior.md).

    With the paper's alpha = 0.05 and beta = 1 the residual counts fully where nothing was measured and
    by 5 % where the density is high; three gapless stacks (M = 3) let 10 % through.

    Args:
        channels: see `ResidualRefiner`.
        units: see `ResidualRefiner`.
        tail_channels: see `ResidualRefiner`.
        alpha: gate at high density.
        beta: gate at zero density.
        use_gate: False sets G = 1 everywhere (an ablation).
        use_density: False hides the density from F (an ablation); the gate still uses it.
        use_sharp: whether F sees V_sharp.
        sharp_base: whether the residual is added to V_sharp instead of V_coarse.

    Raises:
        ValueError: from `DensityGate` or `ResidualRefiner`, or `sharp_base` without `use_sharp`.
    """

    def __init__(
        self,
        channels: Sequence[int] = (32, 64, 96),
        units: Sequence[int] = (1, 2, 3),
        tail_channels: int = 8,
        alpha: float = 0.05,
        beta: float = 1.0,
        use_gate: bool = True,
        use_density: bool = True,
        use_sharp: bool = False,
        sharp_base: bool = False,
    ) -> None:
        super().__init__()
        self.gate = DensityGate(alpha, beta)
        self.refiner = ResidualRefiner(channels, units, tail_channels, use_density, use_sharp)
        self.use_gate = bool(use_gate)
        if sharp_base and not use_sharp:
            raise ValueError("sharp_base needs use_sharp")
        self.sharp_base = bool(sharp_base)

    def arguments(self) -> dict[str, Any]:
        """Return the constructor's arguments as plain Python values, for a checkpoint."""
        return {
            **self.refiner.arguments(),
            "alpha": self.gate.alpha,
            "beta": self.gate.beta,
            "use_gate": self.use_gate,
            "sharp_base": self.sharp_base,
        }

    def forward(self, v_coarse: Tensor, m_rho: Tensor, v_sharp: Tensor | None = None) -> Tensor:
        """Return V_prior.

        Args:
            v_coarse: [B, 1, I, J, K], normalised so that its 99th percentile in the support is 1.
            m_rho: [B, 1, I, J, K], dimensionless density M >= 0.
            v_sharp: [B, 1, I, J, K], on V_coarse's scale; see `sharpened_volume`. Only with `use_sharp`.

        Raises:
            ValueError: `use_sharp` without V_sharp.

        Returns:
            V_prior, [B, 1, I, J, K], in the units of `v_coarse`.
        """
        residual = self.refiner(v_coarse, m_rho, v_sharp)
        base = v_sharp if self.sharp_base else v_coarse
        assert base is not None  # the refiner has refused it
        return base + (self.gate(m_rho) * residual if self.use_gate else residual)
