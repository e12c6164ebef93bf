import dataclasses
import math

import pytest
import torch

from g3r.errors import InputError
from g3r.prior.checkpoint import PriorCheckpoint, load_prior, save_prior_checkpoint
from g3r.prior.dgpn import DensityGatedPriorNetwork


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    network = DensityGatedPriorNetwork((8, 8), (1, 1), 4, alpha=0.1, beta=0.9).eval()
    torch.nn.init.normal_(network.refiner.head.weight)
    return network


@pytest.fixture(scope="module")
def meta(network):
    return PriorCheckpoint(network.arguments(), 0.8, "two phantoms", {"val/psnr_prior": 31.5})


@pytest.fixture(scope="module")
def saved(network, meta, tmp_path_factory):
    path = tmp_path_factory.mktemp("prior") / "prior.pt"
    save_prior_checkpoint(path, network, meta)
    return path


def test_round_trip(saved, network, meta):
    loaded, described = load_prior(saved)
    assert described == meta
    assert (described.alpha, described.beta) == (0.1, 0.9)
    assert described.density_convention == "dimensionless-thickness-v1"
    assert described.intensity_convention == "p99-coarse-v1"
    assert not loaded.training
    assert all(torch.equal(a, b) for a, b in zip(loaded.parameters(), network.parameters(), strict=True))
    inputs = torch.rand(2, 1, 1, 12, 10, 9)
    # Rounding only: the loaded weights lie channels-last, which is another order of summation.
    torch.testing.assert_close(loaded(*inputs), network(*inputs), rtol=1e-5, atol=1e-5)


def test_nothing_is_left_beside_the_file(saved):
    assert [path.name for path in saved.parent.iterdir()] == ["prior.pt"]


def test_saving_a_channels_last_network_writes_the_same(saved, network, meta, tmp_path):
    twin, _ = load_prior(saved)
    save_prior_checkpoint(tmp_path / "twin.pt", twin, meta)
    first, second = (torch.load(path, weights_only=True) for path in (saved, tmp_path / "twin.pt"))
    assert first["weights_sha256"] == second["weights_sha256"]
    assert all(value.is_contiguous() for value in second["weights"].values())


def change(**entries):
    """Return a change of the file's dict that sets entries."""
    return lambda content: content.update(entries)


def change_weight(value):
    def apply(content):
        content["weights"]["refiner.head.weight"] = value

    return apply


REFUSALS = {
    "another tag": (change(format="x"), "not a prior checkpoint"),
    "no tag": (lambda content: content.pop("format"), "not a prior checkpoint"),
    "a training checkpoint": (
        lambda content: content.update({"format": None, "pytorch-lightning_version": "2.6"}),
        "g3r-export",
    ),
    "another format version": (change(format_version=2), "format version is 2"),
    "density per millimetre": (change(density_convention="per-mm"), "density convention is 'per-mm'"),
    "no density convention": (lambda content: content.pop("density_convention"), "density convention is None"),
    "another intensity": (change(intensity_convention="max"), "intensity convention is 'max'"),
    "a missing entry": (lambda content: content.pop("training_data"), "'training_data' is missing"),
    "voxels of 0 mm": (change(voxel_mm=0.0), "voxel size is 0.0 mm"),
    "voxels of NaN": (change(voxel_mm=math.nan), "voxel size is nan mm"),
    "voxels of 80 mm": (change(voxel_mm=80), "voxel size is 80.0 mm"),
    "no number": (change(voxel_mm="thick"), "could not convert"),
    "two alphas": (change(alpha=0.5), "contradict"),
    "weights of another network": (
        lambda content: content["network_arguments"].update(channels=[8, 16]),
        "do not fit together",
    ),
    "an unknown argument": (lambda content: content["network_arguments"].update(depth=3), "do not fit together"),
    "an absurd gate": (
        lambda content: (content["network_arguments"].update(alpha=7.0), content.update(alpha=7.0)),
        "do not fit together",
    ),
    "a missing weight": (lambda content: content["weights"].popitem(), "do not fit together"),
    "weights that are no tensors": (change_weight("heavy"), "do not fit together"),
    "a NaN weight": (change_weight(torch.full((1, 4, 3, 3, 3), math.nan)), "NaN or infinity"),
    "an altered weight": (change_weight(torch.zeros(1, 4, 3, 3, 3)), "checksum"),
    "no weights": (change(weights=None), "contradict"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_refusal_of_an_altered_file(saved, tmp_path, case):
    alter, expected = REFUSALS[case]
    content = torch.load(saved, weights_only=True)
    alter(content)
    path = tmp_path / "altered.pt"
    torch.save(content, path)
    assert_refused(path, expected)


def test_refusal_of_another_voxel_size_than_wanted(saved):
    assert load_prior(saved, 0.8)[1].voxel_mm == 0.8
    with pytest.raises(InputError, match=r"voxels of 0\.8 mm, expected 1 mm; pass another .* --prior-voxel 0\.8"):
        load_prior(saved, 1.0)


def test_refusal_of_a_file_that_is_not_there(tmp_path):
    assert_refused(tmp_path / "none.pt", "no such file")


def test_refusal_of_a_folder(tmp_path):
    assert_refused(tmp_path, "cannot be read")


@pytest.mark.parametrize("text", ["these are not weights\n", "", "cos\nsystem\n(S'true'\ntR."])
def test_refusal_of_a_text_file(tmp_path, text):
    """The last one is a pickle that would run a command."""
    (tmp_path / "notes.pt").write_text(text)
    assert_refused(tmp_path / "notes.pt", "is not a prior checkpoint")


@pytest.mark.parametrize("share", [0.01, 0.5, 0.99])
def test_refusal_of_a_truncated_file(saved, tmp_path, share):
    whole = saved.read_bytes()
    (tmp_path / "part.pt").write_bytes(whole[: int(share * len(whole))])
    assert_refused(tmp_path / "part.pt", "is damaged or not written by g3r-export")


def test_refusal_of_flipped_bits(saved, tmp_path):
    """In the middle of the file there are weights, and zip checksums are not read by torch."""
    content = bytearray(saved.read_bytes())
    for position in range(len(content) // 2, len(content) // 2 + 8):
        content[position] ^= 0x10
    (tmp_path / "flipped.pt").write_bytes(content)
    assert_refused(tmp_path / "flipped.pt", "damaged")


def test_refusal_of_a_bare_tensor(tmp_path):
    torch.save(torch.zeros(3), tmp_path / "tensor.pt")
    assert_refused(tmp_path / "tensor.pt", "holds a Tensor")


def test_refusal_of_an_object_that_would_run_code(tmp_path):
    torch.save({"format": "g3r-prior", "network": DensityGatedPriorNetwork((8,), (1,), 4)}, tmp_path / "object.pt")
    assert_refused(tmp_path / "object.pt", "is damaged or not written by g3r-export")


def test_a_file_that_cannot_be_written(network, meta, tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        save_prior_checkpoint(tmp_path / "no" / "such" / "folder.pt", network, meta)


def test_a_description_of_another_network_is_not_saved(network, meta, tmp_path):
    other = dataclasses.replace(meta, network_arguments={**meta.network_arguments, "alpha": 0.2})
    with pytest.raises(ValueError, match="describes"):
        save_prior_checkpoint(tmp_path / "prior.pt", network, other)


def assert_refused(path, expected):
    with pytest.raises(InputError) as caught:
        load_prior(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: "), message
    assert expected in message
    assert "\n" not in message
