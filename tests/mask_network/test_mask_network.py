"""Shapes, sizes and invariances of the mask network."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from g3r.checkpoints.plain_values import config_from_plain
from g3r.mask_network.config import MaskNetworkConfig
from g3r.mask_network.network import MaskNetwork, SubpixelUNet, normalised, to_channels, to_pixels

SMALL = MaskNetworkConfig(channels=(4, 8, 8))
MAX_WEIGHTS = 3_000_000


@pytest.fixture(scope="module")
def network() -> MaskNetwork:
    torch.manual_seed(0)
    return MaskNetwork(SMALL).eval()


def test_any_size_works(network: MaskNetwork) -> None:
    with torch.inference_mode():
        assert network(torch.rand(1, 1, 21, 18, 5)).shape == (1, 1, 21, 18, 5)
        assert network(torch.rand(2, 1, 33, 30, 3)).shape == (2, 1, 33, 30, 3)


def test_units_of_intensity_do_not_matter(network: MaskNetwork) -> None:
    image = torch.rand(1, 1, 16, 16, 8)
    with torch.inference_mode():
        torch.testing.assert_close(network(image), network(image * 4096), rtol=1e-4, atol=1e-4)


def test_normalised_is_safe_for_black_images() -> None:
    assert torch.equal(normalised(torch.zeros(2, 1, 4, 4, 4)), torch.zeros(2, 1, 4, 4, 4))
    image = torch.rand(1, 1, 20, 20, 10)
    image[..., 0, 0, 0] = 1e6  # one hot pixel
    assert 0.4 < float(normalised(image).mean()) < 0.6
    torch.testing.assert_close(normalised(1e-9 * image), normalised(image))  # independent of units


@pytest.mark.parametrize("factor", [(2, 2, 1), (2, 2, 2)])
def test_channels_and_pixels_are_inverse(factor: tuple[int, int, int]) -> None:
    image = torch.rand(2, 1, 8, 4, 6)
    assert torch.equal(to_pixels(to_channels(image, factor), factor), image)
    blocks = to_channels(image, factor)
    assert torch.equal(blocks[0, :, 0, 0, 0], image[0, 0, :2, :2, : factor[2]].reshape(-1))


def test_flat_levels_do_not_see_other_slices() -> None:
    torch.manual_seed(1)
    flat = SubpixelUNet((4, 8), (2, 2, 1), n_flat=2).eval()
    assert flat.state_dict()["down.0.conv1.conv.weight"].shape[2:] == (3, 3, 1)
    deep = SubpixelUNet((4, 8), (2, 2, 1), n_flat=0)
    assert deep.state_dict()["down.0.conv1.conv.weight"].shape[2:] == (3, 3, 3)


def test_the_trained_network_is_small() -> None:
    settings = yaml.safe_load(Path("lightning_configs/mask.yaml").read_text(encoding="utf-8"))
    given = settings["model"]["init_args"]["network"]
    config = config_from_plain(MaskNetworkConfig, {**asdict(MaskNetworkConfig()), **given})
    n = sum(value.numel() for value in MaskNetwork(config).parameters())
    assert config.min_values() < n < MAX_WEIGHTS


@pytest.mark.parametrize("wrong", [{"wide_mm": 0.0}, {"pixel_mm": np.inf}, {"channels": ()}, {"channels": (0,)}])
def test_impossible_arguments_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match="no mask network"):
        MaskNetworkConfig(**wrong)
