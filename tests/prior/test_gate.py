import math

import pytest
import torch

from g3r.prior.gate import DensityGate, confidence_from_density
from tests.gradients import gradient_of


def test_limits_are_alpha_and_beta() -> None:
    gate = DensityGate(alpha=0.05, beta=1.0)
    m_rho = torch.tensor([0.0, 1e6])
    assert gate(m_rho).tolist() == pytest.approx([1.0, 0.05], rel=1e-7)


def test_three_gapless_stacks_let_a_tenth_through() -> None:
    assert float(DensityGate()(torch.tensor(3.0))) == pytest.approx(0.0973, abs=1e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_matches_the_formula(dtype: torch.dtype) -> None:
    m_rho = torch.linspace(0, 12, 200, dtype=dtype)
    c = torch.tensor([1 - math.exp(-float(m)) for m in m_rho], dtype=dtype)
    torch.testing.assert_close(confidence_from_density(m_rho), c, rtol=0, atol=4 * torch.finfo(dtype).eps)
    torch.testing.assert_close(
        DensityGate(0.1, 0.9)(m_rho), 0.1 * c + 0.9 * (1 - c), rtol=0, atol=8 * torch.finfo(dtype).eps
    )


def test_tiny_density_keeps_its_digits() -> None:
    """1 - exp(-M) would be exactly zero in float32 below 6e-8."""
    m_rho = torch.tensor([1e-30, 1e-12, 1e-8])
    torch.testing.assert_close(confidence_from_density(m_rho), m_rho, rtol=1e-6, atol=0)


def test_value_and_gradient_are_finite_at_the_extremes() -> None:
    m_rho = torch.tensor([0.0, 1e-30, 1e-8, 1.0, 88.0, 1e6, 3e38], requires_grad=True)
    gate = DensityGate()(m_rho)
    gate.sum().backward()
    assert bool(gate.isfinite().all())
    assert bool(gradient_of(m_rho).isfinite().all())
    assert bool((gate.diff() <= 0).all())
    torch.testing.assert_close(gradient_of(m_rho)[:1], torch.tensor([0.05 - 1.0]))


@pytest.mark.parametrize(
    ("alpha", "beta"), [(-0.1, 1.0), (0.5, 0.4), (0.1, 1.5), (0.0, 0.0), (math.nan, 1.0), (0.1, math.nan)]
)
def test_weights_without_meaning_are_refused(alpha: float, beta: float) -> None:
    with pytest.raises(ValueError, match="0 <= alpha <= beta <= 1"):
        DensityGate(alpha, beta)
