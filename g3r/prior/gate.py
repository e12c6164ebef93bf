"""The density gate of Eq. 7, which passes more of the network's residual F where the sampling density is low.

The shipped network was trained on unseen voxels, too: 70 % of its training subjects miss something
(`checkpoints/weights/MODEL_CARD.md`). Deep inside an unseen part it is hardly better than the fitted template; at the
rim it is.
"""

import math

import torch
from torch import Tensor, nn


def confidence_from_density(m_rho: Tensor) -> Tensor:
    """Return the confidence c = 1 - exp(-M) of a sampling density.

    Args:
        m_rho: dimensionless density M >= 0, any shape; 1 where one gapless stack covers once.

    Returns:
        c in [0, 1], same shape; computed as -expm1(-M), which keeps all digits for tiny M.

    Source: G3R Sec. 2.3, "c(x) = 1 - exp(-M_rho(x))".
    """
    return -torch.expm1(-m_rho)


class DensityGate(nn.Module):
    """Weight of the network's residual as a function of density: G(c) = alpha c + beta (1 - c), Eq. 7.

    It has no trainable parameter; alpha and beta are part of the method and travel in the checkpoint.

    Args:
        alpha: weight where the density is high (c -> 1); default 0.05, the paper's.
        beta: weight where there is no density (c = 0); default 1, the paper's.

    Raises:
        ValueError: unless 0 <= alpha <= beta <= 1 and beta > 0, all finite. (A larger beta would only
            rescale the unconstrained network; alpha > beta would let most of it through where the data are dense.)

    Numerics: exp(-M) and expm1(-M) are bounded for every M >= 0, so the value and its gradient
        (alpha - beta) exp(-M) are finite for M = 0, 1e-30 and 1e6. M must not be negative: a
        precondition that `acquisition.coverage` keeps; it is not checked per voxel here.
    """

    def __init__(self, alpha: float = 0.05, beta: float = 1.0) -> None:
        super().__init__()
        # the comparison chain is also False for NaN
        if not (0.0 <= alpha <= beta <= 1.0 and beta > 0.0 and math.isfinite(beta)):
            raise ValueError(f"DensityGate needs 0 <= alpha <= beta <= 1 and beta > 0; got {alpha=}, {beta=}")
        self.alpha = float(alpha)
        self.beta = float(beta)

    def forward(self, m_rho: Tensor) -> Tensor:
        """Return G in [alpha, beta] for a density M >= 0 of any shape."""
        # 1 - c is exp(-M) exactly; 1 - (1 - exp(-M)) would lose it for large M.
        return self.alpha * confidence_from_density(m_rho) + self.beta * torch.exp(-m_rho)

    def extra_repr(self) -> str:
        """Show alpha and beta when the module is printed."""
        return f"alpha={self.alpha}, beta={self.beta}"
