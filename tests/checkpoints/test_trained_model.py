"""Priors and pose networks as files: saving and loading preserve them, and damaged files are refused."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from g3r.checkpoints.shipped import SET_NAMES, set_of, weights_path
from g3r.checkpoints.trained_model import TrainedModel
from g3r.checkpoints.weights_file import read_weights
from g3r.errors import InputError
from g3r.pose_network.model import PoseModel
from g3r.prior.dgpn import DensityGatedPriorNetwork
from g3r.prior.inputs import PriorInputs
from g3r.prior.model import Prior
from tests.checkpoints.altered_files import Content, content_of, small_pose, small_prior, write_content

MODELS: dict[str, Callable[[], TrainedModel]] = {"prior": small_prior, "pose": small_pose}


@pytest.fixture(scope="module", params=MODELS)
def model(request: pytest.FixtureRequest) -> TrainedModel:
    return MODELS[request.param]()


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("models")
    for name, make in MODELS.items():
        make().save(folder / f"{name}.safetensors")
    return {name: folder / f"{name}.safetensors" for name in MODELS}


def test_loading_a_saved_model_restores_record_and_weights(model: TrainedModel, saved: dict[str, Path]) -> None:
    path = saved[model.kind]
    loaded = type(model).load(path)
    assert loaded.record() == model.record()
    assert not loaded.network.training
    rounding = {"rtol": 2**-10, "atol": 1e-7} if model.kind == "pose" else {"rtol": 0, "atol": 0}  # float16
    for one, other in zip(loaded.network.parameters(), model.network.parameters(), strict=True):
        torch.testing.assert_close(one, other, **rounding)
        assert one.dtype == torch.float32
    assert loaded.file_name == path.name
    assert loaded.file_sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_saving_what_was_loaded_writes_the_same(model: TrainedModel, saved: dict[str, Path], tmp_path: Path) -> None:
    """This holds for any memory format of the loaded weights."""
    type(model).load(saved[model.kind]).save(tmp_path / "twin.safetensors")
    assert (tmp_path / "twin.safetensors").read_bytes() == saved[model.kind].read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["twin.safetensors"]


def test_the_prior_s_file_says_all_that_has_to_be_known(saved: dict[str, Path]) -> None:
    prior, said = Prior.load(saved["prior"]), content_of(saved["prior"])
    assert (prior.network.config.alpha, prior.network.config.beta) == (0.1, 0.9)
    assert (said["network_arguments"]["alpha"], said["network_arguments"]["beta"]) == (0.1, 0.9)
    assert prior.voxel_mm == said["voxel_mm"] == 0.8
    assert said["density_convention"] == "dimensionless-whole-slice-v2"
    assert said["intensity_convention"] == "p99-coarse-v1"
    assert said["sharp_convention"] == "cg6-smoothness0.1-v1"
    names = ("coarse", "density", "template", "outline")
    given = PriorInputs(**dict(zip(names, torch.rand(4, 1, 1, 12, 10, 9), strict=True)))
    for one, other in zip(prior.network(given), small_prior().network(given), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_the_prior_s_file_holds_its_template(saved: dict[str, Path]) -> None:
    prior, before = Prior.load(saved["prior"]), small_prior()
    assert prior.weeks == (25.0, 31.0)
    assert prior.template.weeks.tolist() == [25, 31]
    np.testing.assert_array_equal(prior.template.volume, before.template.volume)
    np.testing.assert_allclose(prior.template.affine @ [1.5, 2, 1, 1], [0, 0, 0, 1], atol=1e-9)
    stored = content_of(saved["prior"])["weights"]["template"]
    assert stored.dtype == torch.float16
    assert prior.network.template.dtype == torch.float32


def test_the_pose_network_s_file_holds_its_template(saved: dict[str, Path]) -> None:
    pose, before = PoseModel.load(saved["pose"]), small_pose()
    assert pose.template.weeks.tolist() == [25, 31]
    np.testing.assert_array_equal(pose.template.volume, before.template.volume)
    np.testing.assert_allclose(pose.template.affine @ [2, 2.5, 1.5, 1], [0, 0, 0, 1], atol=1e-9)
    n_values = sum(value.numel() for value in before.network.state_dict().values())
    assert saved["pose"].stat().st_size < 2 * n_values + 60_000  # two bytes each


SHIPPED: dict[tuple[type[TrainedModel], str | None], str] = {
    (Prior, None): "aae96a04d906a9af",
    (PoseModel, None): "91988be504221c6d",
    (Prior, "cc0"): "3b45b97d59086dcf",
    (PoseModel, "cc0"): "b20fc91e61e6be69",
}


@pytest.mark.parametrize(("kind", "name"), SHIPPED)
def test_the_shipped_weights(kind: type[TrainedModel], name: str | None) -> None:
    """Their checksum is the one written by the export of their training, so every value is unchanged."""
    shipped = kind.load(name)
    assert shipped.file_name == weights_path(name, kind.kind).name
    assert shipped.weights_sha256.startswith(SHIPPED[kind, name])


def test_a_named_set_has_weights_of_every_kind() -> None:
    assert {name for _, name in SHIPPED} == {None, *SET_NAMES}
    assert all("source=spina-bifida," in kind.load(name).training_data for kind, name in SHIPPED if name == "cc0")


def test_a_path_is_not_a_set(tmp_path: Path) -> None:
    assert weights_path("./cc0", "prior") == Path("cc0")
    assert weights_path(tmp_path, "pose") == tmp_path
    assert set_of("cc0") == "cc0"
    assert set_of("./cc0") is set_of(None) is set_of(tmp_path) is None


def change(**entries: Any) -> Callable[[Content], object]:
    return lambda content: content.update(entries)


def without(name: str) -> Callable[[Content], object]:
    return lambda content: content.pop(name)


def arguments(**entries: Any) -> Callable[[Content], object]:
    return lambda content: content["network_arguments"].update(entries)


def weight(name: str, value: torch.Tensor) -> Callable[[Content], object]:
    return lambda content: content["weights"].update({name: value})


def one_value(name: str, value: float) -> Callable[[Content], object]:
    def apply(content: Content) -> None:
        content["weights"][name].view(-1)[0] = value

    return apply


HEAD, TOKEN, COUNTER = "refiner.head.weight", "encoder.token.bias", "encoder.stem.adn.N.num_batches_tracked"
UNFIT = "do not fit together"
REFUSALS: dict[str, tuple[str, Callable[[Content], object], str]] = {
    "another kind": ("prior", change(format="g3r-pose"), "not a prior checkpoint"),
    "another kind of pose": ("pose", change(format="g3r-prior"), "not a pose checkpoint"),
    "no kind": ("prior", without("format"), "not a prior checkpoint"),
    "an earlier format version": ("prior", change(format_version=1), "format version is 1, this g3r reads 2"),
    "a later format version": ("pose", change(format_version=7), "format version is 7"),
    "density of the masked pixels": (
        "prior",
        change(density_convention="dimensionless-thickness-v1"),
        "density convention is 'dimensionless-thickness-v1'",
    ),
    "density per millimetre": ("prior", change(density_convention="per-mm"), "density convention is 'per-mm'"),
    "no density convention": ("prior", without("density_convention"), "density convention is None"),
    "another intensity": ("prior", change(intensity_convention="max"), "intensity convention is 'max'"),
    "another V_sharp": ("prior", change(sharp_convention="x"), "sharp convention is 'x'"),
    "no training data": ("prior", without("training_data"), "'training_data' is missing"),
    "no arguments": ("pose", without("network_arguments"), "'network_arguments' is missing"),
    "no validation": ("pose", without("validation"), "'validation' is missing"),
    "scores that are a list": ("prior", change(validation=[1.0]), "validation is a list, expected named numbers"),
    "a score that is a text": ("prior", change(validation={"a": "b"}), "could not convert a 'b'"),
    "voxels of 0 mm": ("prior", change(voxel_mm=0.0), "voxel size is 0.0 mm"),
    "voxels of NaN": ("prior", change(voxel_mm=math.nan), "voxel size is nan mm"),
    "voxels of 80 mm": ("prior", change(voxel_mm=80), "voxel size is 80.0 mm"),
    "no number": ("prior", change(voxel_mm="thick"), "could not convert"),
    "no ages": ("pose", without("weeks"), "'weeks' is missing"),
    "too few ages": ("pose", change(weeks=[25.0]), "1 ages for a template of 2"),
    "no ages of the prior's template": ("prior", without("weeks"), "'weeks' is missing"),
    "too few ages of it": ("prior", change(weeks=[25.0]), "1 ages for a template of 2"),
    "another template of the prior": ("prior", arguments(template_shape=[2, 4, 5, 4]), UNFIT),
    "ages that are a text": ("pose", change(weeks="25"), "weeks is '25', expected a list"),
    "an unknown argument": ("prior", arguments(depth=3), "network argument depth is unknown"),
    "a missing argument": (
        "prior",
        lambda content: content["network_arguments"].pop("units"),
        "network argument units is missing",
    ),
    "arguments that are a list": ("prior", change(network_arguments=[1]), "network arguments are not named"),
    "a number for a list": ("prior", arguments(channels=4), "channels is 4, expected a list of int"),
    "a list for a number": ("prior", arguments(alpha=[0.1]), "alpha is a list, expected float"),
    "a fraction for a count": ("prior", arguments(tail_channels=2.0), "tail_channels is 2.0, expected int"),
    "a number for a switch": ("prior", arguments(use_gate=1), "use_gate is 1, expected bool"),
    "a gate without meaning": ("prior", arguments(alpha=7.0), UNFIT),
    "no channels": ("pose", arguments(channels=[]), "no pose network has these arguments"),
    "a template without a voxel size": ("pose", arguments(template_spacing_mm=0.0), "no pose network"),
    "weights of another network": ("prior", arguments(channels=[4, 6]), UNFIT),
    "another width": ("pose", arguments(width=16), UNFIT),
    "another template": ("pose", arguments(template_shape=[2, 5, 6, 5]), UNFIT),
    "a missing weight": ("prior", lambda content: content["weights"].pop(HEAD), f"{UNFIT}.*is missing"),
    "an unknown weight": ("prior", weight("x", torch.ones(1)), f"{UNFIT}.*'x' is unknown"),
    "a counter for a weight": ("prior", weight("refiner.head.bias", torch.ones(1).long()), f"{UNFIT}.*I64"),
    "a weight for a counter": ("pose", weight(COUNTER, torch.zeros(())), f"{UNFIT}.*F32"),
    "a NaN weight": ("prior", one_value(HEAD, math.nan), "NaN or infinity"),
    "an infinite weight": ("pose", one_value(TOKEN, math.inf), "NaN or infinity"),
    "an altered weight": ("prior", one_value(HEAD, 0.0), "do not match their checksum"),
    "another altered weight": ("pose", one_value(TOKEN, 3.0), "do not match their checksum"),
    "no checksum": ("pose", without("weights_sha256"), "do not match their checksum"),
    "no weights": ("prior", lambda content: content["weights"].clear(), UNFIT),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_refusal_of_an_altered_file(name: str, saved: dict[str, Path], tmp_path: Path) -> None:
    kind, alter, says = REFUSALS[name]
    content = content_of(saved[kind])
    alter(content)
    write_content(tmp_path / "altered.safetensors", content)
    assert_refused({"prior": Prior, "pose": PoseModel}[kind], tmp_path / "altered.safetensors", says)


@pytest.mark.parametrize("share", [0.01, 0.5, 0.99])
def test_refusal_of_a_truncated_file(model: TrainedModel, saved: dict[str, Path], tmp_path: Path, share: float) -> None:
    whole = saved[model.kind].read_bytes()
    (tmp_path / "part").write_bytes(whole[: int(share * len(whole))])
    assert_refused(type(model), tmp_path / "part", "is damaged or not written by g3r-export")


def test_refusal_of_flipped_bits(model: TrainedModel, saved: dict[str, Path], tmp_path: Path) -> None:
    """The bits are flipped at the end of the file, which holds weights."""
    content = bytearray(saved[model.kind].read_bytes())
    for position in range(len(content) - 16, len(content)):
        content[position] ^= 0x10
    (tmp_path / "flipped").write_bytes(content)
    assert_refused(type(model), tmp_path / "flipped", "checksum|NaN or infinity")


def test_a_file_of_torch_save_is_refused_with_the_way_on(model: TrainedModel, tmp_path: Path) -> None:
    torch.save({"format": f"g3r-{model.kind}", "weights": {}}, tmp_path / "old.pt")
    assert_refused(type(model), tmp_path / "old.pt", r"export the run's \.ckpt again with g3r-export")


def test_a_prior_of_absurd_voxels_is_not_made() -> None:
    network = small_prior().network
    with pytest.raises(ValueError, match=r"voxel size is 1000\.0 mm"):
        Prior(network=network, voxel_mm=1e3, weeks=(25.0, 31.0), training_data="")
    with pytest.raises(ValueError, match="3 ages for a template of 2"):
        Prior(network=network, voxel_mm=0.8, weeks=(25.0, 28.0, 31.0), training_data="")


def test_a_network_is_built_only_if_the_file_can_fill_it(
    saved: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = content_of(saved["prior"])
    content["network_arguments"] |= {"channels": [4096, 4096], "units": [64, 64]}
    write_content(tmp_path / "wide", content)
    monkeypatch.setattr(DensityGatedPriorNetwork, "__init__", lambda *_: pytest.fail("was built"))
    assert_refused(Prior, tmp_path / "wide", f"{UNFIT}.*values for at least")


def assert_refused(kind: type[TrainedModel], path: Path, says: str) -> None:
    with pytest.raises(InputError, match=says) as caught:
        kind.load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: "), message
    assert "\n" not in message


def test_a_file_that_was_read_already_is_not_opened_again(saved: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "prior.safetensors"
    path.write_bytes(saved["prior"].read_bytes())
    file = read_weights(path, "prior")
    path.unlink()
    assert Prior.load(file).record() == Prior.load(saved["prior"]).record()
