"""The pose file: what goes in comes out, and what is damaged is refused."""

import dataclasses

import numpy as np
import pytest
import torch

from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.errors import InputError
from g3r.pose_network.checkpoint import PoseCheckpoint, centred_grid, load_pose_network, save_pose_checkpoint
from g3r.pose_network.network import PoseNetwork

SHAPE = (2, 8, 9, 10)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return PoseNetwork(SHAPE, channels=(4, 8, 8), width=32, n_blocks=2, n_heads=2).eval()


@pytest.fixture(scope="module")
def meta(network):
    heads = np.random.default_rng(0).random(SHAPE).astype(np.float16).astype(np.float32)
    template = AtlasTemplate(heads, centred_grid(SHAPE, 3.0).affine, np.array([25.0, 31.0]))
    return PoseCheckpoint(network.arguments(), template, "two phantoms", {"val/slice_mm": 4.5})


@pytest.fixture(scope="module")
def saved(network, meta, tmp_path_factory):
    path = tmp_path_factory.mktemp("pose") / "pose.pt"
    save_pose_checkpoint(path, network, meta)
    return path


def test_round_trip(saved, network, meta):
    loaded, described = load_pose_network(saved)
    assert not loaded.training
    assert described.network_arguments == meta.network_arguments
    assert (described.pixel_mm, described.image_size) == (3.0, 40)
    assert (described.training_data, dict(described.validation)) == ("two phantoms", {"val/slice_mm": 4.5})
    np.testing.assert_array_equal(described.template.volume, meta.template.volume)
    np.testing.assert_allclose(described.template.affine, meta.template.affine)
    assert described.template.weeks.tolist() == [25, 31]
    torch.testing.assert_close(loaded.template.permute(3, 0, 1, 2), torch.from_numpy(meta.template.volume))
    for one, other in zip(loaded.parameters(), network.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=2**-10, atol=1e-7)  # rounded to float16
        assert one.dtype == torch.float32


def test_weights_take_two_bytes(saved, network):
    n_values = sum(v.numel() for v in network.state_dict().values())
    assert saved.stat().st_size < 2 * n_values + 60_000


def change(**entries):
    return lambda content: content.update(entries)


def without(name):
    return lambda content: content.pop(name)


def flip_a_bit(content):
    content["weights"]["encoder.token.bias"][0] += 1


def poison(content):
    content["weights"]["encoder.token.bias"][0] = float("nan")


def other_arguments(**entries):
    return lambda content: content["network_arguments"].update(entries)


REFUSALS = {
    "another tag": (change(format="g3r-prior"), "not a pose checkpoint"),
    "a training checkpoint": (
        change(format=None, **{"pytorch-lightning_version": "2.6"}),
        "turn it into a pose with g3r-export",
    ),
    "another version": (change(format_version=7), "format version is 7"),
    "no weights": (without("weights"), "holds no weights"),
    "no arguments": (without("network_arguments"), "'network_arguments' is missing"),
    "no ages": (without("weeks"), "'weeks' is missing"),
    "ages that do not fit": (change(weeks=[25.0]), "template"),
    "no validation": (without("validation"), "'validation' is missing"),
    "another weight": (flip_a_bit, "do not match their checksum"),
    "no checksum": (without("weights_sha256"), "do not match their checksum"),
    "NaN": (poison, "NaN or infinity"),
    "an unknown argument": (other_arguments(depth=3), "do not fit together"),
    "no channels": (other_arguments(channels=[]), "do not fit together"),
    "a template without a voxel size": (other_arguments(template_spacing_mm=0.0), "singular"),
    "another width": (other_arguments(width=64), "do not fit together"),
    "another template": (other_arguments(template_shape=[3, 8, 9, 10]), "do not fit together"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_refusals(saved, tmp_path, name):
    damage, message = REFUSALS[name]
    content = torch.load(saved, weights_only=True)
    damage(content)
    path = tmp_path / "damaged.pt"
    torch.save(content, path)
    with pytest.raises(InputError, match=message) as error:
        load_pose_network(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["missing", "text", "cut", "a list"])
def test_files_that_are_none(saved, tmp_path, kind):
    path = tmp_path / "file.pt"
    if kind == "text":
        path.write_text("hello")
    elif kind == "cut":
        path.write_bytes(saved.read_bytes()[: saved.stat().st_size // 2])
    elif kind == "a list":
        torch.save([1, 2], path)
    with pytest.raises(InputError, match=r"pose|damaged"):
        load_pose_network(path)


def test_a_description_of_another_network(network, meta, tmp_path):
    other = dataclasses.replace(meta, network_arguments={**meta.network_arguments, "width": 64})
    with pytest.raises(ValueError, match="describes"):
        save_pose_checkpoint(tmp_path / "x.pt", network, other)


def test_a_template_of_another_grid(meta):
    shifted = AtlasTemplate(meta.template.volume, np.diag([3.0, 3, 3, 1]), meta.template.weeks)
    with pytest.raises(ValueError, match="not the network's"):
        dataclasses.replace(meta, template=shifted)
