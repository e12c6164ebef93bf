"""Mask inference from stack to mask, with a network that takes bright pixels for brain; refusals."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from g3r.mask_network.config import MaskNetworkConfig
from g3r.mask_network.inference import find_brain
from g3r.mask_network.mask_shape import as_people_draw
from g3r.mask_network.mirrored import FLIPS, FURTHER_FLIPS
from g3r.mask_network.model import MaskModel
from g3r.mask_network.network import MaskNetwork
from g3r.mask_network.places import N_PLACES, is_agreed, likely_places

SPACING_MM = (1.1, 1.3, 3.5)
N_LOOKS = len(FLIPS) + len(FURTHER_FLIPS)


class BrightIsBrain(torch.nn.Module):
    config = MaskNetworkConfig()

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return (image - 0.5) * 40


@pytest.fixture
def stub() -> Any:
    return SimpleNamespace(network=BrightIsBrain())


class Watched(BrightIsBrain):
    """Records its inputs."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[torch.Tensor] = []

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        self.seen.append(image)
        return super().forward(image)


class BlindAtFirst(Watched):
    """Finds nothing in the first pass over the whole stack."""

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        logits = super().forward(image)
        return logits if len(self.seen) > N_LOOKS else torch.full_like(logits, -20.0)


class BlindWhenTurned(Watched):
    """Finds nothing in its second pass."""

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        logits = super().forward(image)
        return torch.full_like(logits, -20.0) if len(self.seen) == 2 else logits


def ball(shape: tuple[int, int, int], centre_mm: tuple[float, float, float], radius_mm: float) -> np.ndarray:
    at = np.stack(np.meshgrid(*(np.arange(n) * mm for n, mm in zip(shape, SPACING_MM, strict=True)), indexing="ij"), -1)
    return np.linalg.norm(at - np.array(centre_mm), axis=-1) < radius_mm


def folded(inside: np.ndarray) -> np.ndarray:
    """A bright object with as much detail as a brain."""
    wave = np.sin(np.arange(len(inside)) * SPACING_MM[0] * 2 * np.pi / 20)[:, None, None]
    return (inside * (1 + 0.3 * wave)).astype(np.float32)


@pytest.mark.parametrize("centre", [(90.0, 70.0, 40.0), (35.0, 120.0, 50.0), (20.0, 90.0, 8.0)])
def test_a_ball_is_outlined_where_it_is(stub: Any, centre: tuple[float, float, float]) -> None:
    true = ball((160, 140, 25), centre, 32.0)
    found = find_brain(folded(true), SPACING_MM, stub)
    assert found.found
    middle = np.argwhere(true).mean(0) * SPACING_MM
    true = as_people_draw(true, np.array(SPACING_MM))
    assert 2 * (found.mask & true).sum() / (found.mask.sum() + true.sum()) > 0.97
    np.testing.assert_allclose(found.centre_mm, middle, atol=1.0)
    assert found.volume_ml == pytest.approx(true.sum() * np.prod(SPACING_MM) / 1000, rel=0.05)
    assert found.presence > 0.9
    assert not found.probability[~ball((160, 140, 25), centre, 120.0)].any()


def test_the_largest_of_two_is_taken(stub: Any) -> None:
    large, small = ball((160, 140, 25), (60.0, 60.0, 40.0), 28.0), ball((160, 140, 25), (140.0, 140.0, 40.0), 16.0)
    found = find_brain(folded(large | small), SPACING_MM, stub)
    assert (found.mask & large).sum() > 0.9 * large.sum()
    assert not (found.mask & small).any()


def test_a_ball_without_folds_is_no_head(stub: Any) -> None:
    even, head = ball((160, 140, 25), (60.0, 60.0, 40.0), 32.0), ball((160, 140, 25), (140.0, 140.0, 40.0), 20.0)
    found = find_brain(even.astype(np.float32), SPACING_MM, stub)
    assert not found.found
    assert "even" in found.reason
    # an object with folds is preferred, although it is smaller
    found = find_brain(even + folded(head), SPACING_MM, stub)
    assert (found.mask & head).sum() > 0.9 * head.sum()
    assert not (found.mask & even).any()


def test_where_nothing_is_seen_a_second_look_has_even_brightness() -> None:
    head, bright = ball((160, 140, 25), (60.0, 60.0, 40.0), 32.0), ball((160, 140, 25), (170.0, 170.0, 40.0), 25.0)
    image = (0.8 * folded(head) + 8 * bright).astype(np.float32)
    network = BlindAtFirst()
    found = find_brain(image, SPACING_MM, SimpleNamespace(network=network))  # type: ignore[arg-type]
    assert (found.mask & head).sum() > 0.9 * head.sum()
    first, second = network.seen[0], network.seen[N_LOOKS]
    assert first.shape == second.shape
    middle = [round(mm / 2.4) for mm in (60.0, 60.0)], [round(mm / 2.4) for mm in (170.0, 170.0)]
    (own, other), (own_even, other_even) = ([one[0, 0, i, j, 11] for i, j in middle] for one in (first, second))
    assert other / own > 5
    assert other_even / own_even < 2


@pytest.mark.parametrize("rival_mm", [0.0, 9.0, 30.0])
def test_a_place_without_a_rival_is_looked_at_alone(rival_mm: float) -> None:
    """Only a place of nearly the same size is a rival; the head is found in both cases."""
    head, other = ball((160, 140, 25), (60.0, 60.0, 40.0), 32.0), ball((160, 140, 25), (140.0, 140.0, 40.0), rival_mm)
    network = Watched()
    found = find_brain(folded(head) + 0.9 * folded(other), SPACING_MM, SimpleNamespace(network=network))  # type: ignore[arg-type]
    assert (found.mask & head).sum() > 0.9 * head.sum()
    n_near = len(network.seen) - len(FLIPS)  # without the passes over the wide images
    assert sum(image.shape == network.seen[0].shape for image in network.seen) == len(FLIPS)
    assert (n_near > 2 + len(FLIPS)) == (rival_mm == 30.0)  # one place, a second time and mirrored


def test_mirror_images_that_disagree_are_not_all() -> None:
    head = ball((160, 140, 25), (60.0, 60.0, 40.0), 32.0)
    network = BlindWhenTurned()
    find_brain(folded(head), SPACING_MM, SimpleNamespace(network=network))  # type: ignore[arg-type]
    assert sum(image.shape == network.seen[0].shape for image in network.seen) == N_LOOKS


@pytest.mark.parametrize("turned_mm", [0.0, 40.0])
def test_mirror_images_agree_on_a_place_that_both_show(turned_mm: float) -> None:
    head = np.zeros((40, 40, 20), np.float32)
    head[6:20, 6:20, 6:14] = 1.0
    turned = np.roll(head, round(turned_mm / 4.0), axis=0)
    mean: np.ndarray = (head + turned) / 2
    assert is_agreed(likely_places(mean, np.full(3, 4.0)), [head, turned], np.full(3, 4.0)) == (turned_mm == 0)


def test_too_little_is_no_head(stub: Any) -> None:
    found = find_brain(ball((160, 140, 25), (60.0, 60.0, 40.0), 12.5).astype(np.float32), SPACING_MM, stub)
    assert not found.found
    assert "ml" in found.reason
    assert not found.mask.any()
    assert np.isnan(found.centre_mm).all()


@pytest.mark.parametrize(
    ("image", "says"),
    [
        (np.full((20, 20, 5), np.nan), "NaN"),
        (np.zeros((20, 20, 5)), "every value"),
        (np.ones((20, 20)), "shape"),
        (np.ones((20, 0, 5)), "shape"),
    ],
)
def test_what_is_no_image_is_refused(stub: Any, image: np.ndarray, says: str) -> None:
    found = find_brain(image, SPACING_MM, stub)
    assert not found.found
    assert says in found.reason


def test_impossible_spacings_are_refused(stub: Any) -> None:
    for spacing in ((1.0, 0.0, 3.0), (1.0, np.nan, 3.0), (1.0, 1.0)):
        assert "spacing" in find_brain(np.random.default_rng(0).random((9, 9, 9)), spacing, stub).reason


def test_an_untrained_network_finds_no_head_in_noise(rng: np.random.Generator) -> None:
    torch.manual_seed(0)
    network = MaskNetwork(MaskNetworkConfig(channels=(4, 8))).eval()
    network.unet.out.conv.conv.bias.data.fill_(-4.0)
    model = MaskModel(network=network, training_data="nothing")
    assert not find_brain(rng.random((64, 60, 10)), (2.0, 2.0, 4.0), model).found


def test_places_have_most_probability_about_them_and_are_apart() -> None:
    probability = np.zeros((40, 40, 20), np.float32)
    probability[6:14, 6:14, 6:14] = 0.6
    probability[28:34, 28:34, 8:14] = 0.9
    first, second, *others = likely_places(probability, np.full(3, 4.0))
    assert np.abs(first.voxel - [9.5, 9.5, 9.5]).max() <= 1
    assert np.abs(second.voxel - [30.5, 30.5, 10.5]).max() <= 1
    assert first.probability > second.probability
    assert len(others) <= N_PLACES - 2
    assert likely_places(np.zeros((3, 3, 3), np.float32), np.full(3, 4.0)) == []
