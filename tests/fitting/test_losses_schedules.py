"""The terms of the losses and how their weights change."""

import math

import numpy as np
import pytest
import torch

from g3r.errors import NumericalError
from g3r.fitting.losses import scale_regulariser, weighted_l1
from g3r.fitting.parameters import CloudParameters, LearningRates
from g3r.fitting.schedules import AnnealedWeight, cosine_decay
from g3r.gaussians import GaussianCloud


def test_annealed_weight_at_and_between_its_ends():
    weight = AnnealedWeight(0.5, 0.1, 0.2, 0.8)
    assert weight.at(0.0) == weight.at(0.1999) == 0.5
    assert weight.at(0.2) == 0.5
    assert weight.at(0.5) == pytest.approx(0.3)
    assert weight.at(0.35) == pytest.approx(0.4)
    assert weight.at(0.8) == weight.at(0.9) == weight.at(1.0) == 0.1
    values = [weight.at(f) for f in np.linspace(0, 1, 500)]
    assert (np.diff(values) <= 1e-15).all()
    assert np.abs(np.diff(values)).max() < 0.002  # no jump


def test_annealed_weight_with_equal_fractions_is_a_step():
    weight = AnnealedWeight(0.5, 0.1, 0.4, 0.4)
    assert weight.at(0.4 - 1e-9) == 0.5
    assert weight.at(0.4) == 0.1


@pytest.mark.parametrize(("tau", "first", "last"), [(0.0, 0.1, 0.1), (1.0, 0.5, 0.1)])
def test_annealed_weight_at_the_borders(tau: float, first: float, last: float):
    weight = AnnealedWeight(0.5, 0.1, tau, tau)
    assert (weight.at(0.0), weight.at(1.0)) == (first, last)


def test_annealed_weight_may_grow_and_may_be_zero():
    assert AnnealedWeight(0.0, 1.0, 0.0, 1.0).at(0.25) == 0.25
    assert AnnealedWeight(0.0, 0.0).at(0.5) == 0.0


@pytest.mark.parametrize(
    "arguments",
    [
        (0.5, 0.1, 0.8, 0.2), (0.5, 0.1, -0.1, 0.5), (0.5, 0.1, 0.5, 1.1), (0.5, 0.1, math.nan, 0.5),
        (-0.5, 0.1), (0.5, -0.1), (math.nan, 0.1), (math.inf, 0.1),
    ],
)  # fmt: skip
def test_annealed_weight_refuses(arguments):
    with pytest.raises(ValueError, match="expected"):
        AnnealedWeight(*arguments)


def test_cosine_decay():
    assert cosine_decay(0.0) == cosine_decay(0.39) == 1.0
    assert cosine_decay(0.4) == pytest.approx(1.0)
    assert cosine_decay(0.7) == pytest.approx((1 + 0.05) / 2)
    assert cosine_decay(1.0) == pytest.approx(0.05)
    values = [cosine_decay(f) for f in np.linspace(0, 1, 300)]
    assert (np.diff(values) <= 0).all()


def test_weighted_l1_is_a_weighted_mean():
    prediction, target = torch.tensor([1.0, 2.0, 5.0]), torch.tensor([0.0, 4.0, 5.5])
    assert weighted_l1(prediction, target, torch.ones(3)).item() == pytest.approx(3.5 / 3)
    weight = torch.tensor([1.0, 3.0, 0.0])
    assert weighted_l1(prediction, target, weight).item() == pytest.approx(7 / 4)
    # only the ratio of weights matters
    torch.testing.assert_close(weighted_l1(prediction, target, 1e-20 * weight), torch.tensor(7 / 4))


@pytest.mark.parametrize("n", [0, 4])
def test_weighted_l1_where_nothing_counts(n: int):
    prediction = torch.ones(n, requires_grad=True)
    loss = weighted_l1(prediction, torch.zeros(n), torch.zeros(n))
    loss.backward()
    assert loss.item() == 0
    assert torch.isfinite(prediction.grad).all()


def test_a_pixel_of_weight_zero_gets_no_gradient():
    prediction = torch.tensor([1.0, 2.0], requires_grad=True)
    weighted_l1(prediction, torch.zeros(2), torch.tensor([0.0, 2.0])).backward()
    assert prediction.grad.tolist() == [0.0, 1.0]


def test_scale_regulariser_is_a_pure_number():
    seed = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    assert scale_regulariser(seed, seed).item() == 0
    doubled = scale_regulariser(seed + math.log(2), seed)
    assert doubled.item() == pytest.approx(math.log(2) ** 2, rel=1e-5)
    assert scale_regulariser(seed - math.log(2), seed).item() == pytest.approx(doubled.item(), rel=1e-5)


def one_gaussian() -> GaussianCloud:
    return GaussianCloud(
        torch.zeros(1, 3),
        torch.zeros(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1,), 2.0),
        np.zeros(3),
    )


def test_a_step_is_about_as_long_as_its_rate_says():
    rates = LearningRates()
    parameters = CloudParameters(one_gaussian(), rates)
    parameters.set_factor(0.5)
    parameters.step(sum(p.sum() for p in parameters.cloud().parameters))
    cloud = parameters.cloud().detach()
    np.testing.assert_allclose(cloud.mean_mm, -0.5 * rates.mean_share, rtol=1e-4)  # sigma is 1 mm
    np.testing.assert_allclose(cloud.log_scale, -0.5 * rates.log_scale, rtol=1e-4)
    np.testing.assert_allclose(cloud.peak, 2 - 0.5 * rates.peak_share * 2, rtol=1e-4)


def test_a_loss_that_is_not_finite_stops_the_fit():
    parameters = CloudParameters(one_gaussian(), LearningRates())
    with pytest.raises(NumericalError, match="not finite") as caught:
        parameters.step(parameters.cloud().peak.sum() * math.nan)
    assert caught.value.exit_code == 4
    assert torch.equal(parameters.cloud().peak.detach(), one_gaussian().peak)
