"""The file format of exported weights: header claims are checked before memory is allocated."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import pytest
import torch
from safetensors.torch import save

from g3r.checkpoints.weights_file import MAX_HEADER_BYTES, read_weights, write_weights
from g3r.errors import InputError
from tests.checkpoints.altered_files import change_header, with_header

TENSORS = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.ones(4).half(), "n": torch.tensor(7)}
SAID = {"format": "g3r-prior", "numbers": [1, 2.5]}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_weights(tmp_path / "a.safetensors", SAID, TENSORS)
    return tmp_path / "a.safetensors"


def test_written_weights_are_read_back_with_description_values_and_dtypes(file: Path) -> None:
    found = read_weights(file, "prior")
    assert found.description == SAID
    tensors = found.tensors()
    assert tensors.keys() == TENSORS.keys()
    for name, value in TENSORS.items():
        assert torch.equal(tensors[name], value)
        assert tensors[name].dtype == value.dtype
        assert found.claims[name].shape == tuple(value.shape)
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_equal_content_is_equal_bytes(file: Path, tmp_path: Path) -> None:
    write_weights(tmp_path / "b.safetensors", SAID, dict(reversed(TENSORS.items())))
    assert (tmp_path / "b.safetensors").read_bytes() == file.read_bytes()
    assert read_weights(tmp_path / "b.safetensors", "prior").sha256 == read_weights(file, "prior").sha256


def test_it_is_a_file_that_others_read(file: Path) -> None:
    from safetensors import safe_open

    with safe_open(file, "pt") as opened:
        assert json.loads(opened.metadata()["g3r"]) == SAID
        assert torch.equal(opened.get_tensor("a"), TENSORS["a"])


def test_a_file_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        write_weights(tmp_path / "no" / "such" / "folder.safetensors", SAID, TENSORS)


HUGE = {"dtype": "F32", "shape": [50_000, 50_000], "data_offsets": [0, 10_000_000_000]}
LIES = {
    "a shape of 10 GB": lambda header: header.update(a=HUGE),
    "a shape of more bytes": lambda header: header["a"].update(shape=[2, 4]),
    "a shape of fewer bytes": lambda header: header["a"].update(shape=[2, 2]),
    "a negative shape": lambda header: header["a"].update(shape=[-2, -3]),
    "a shape beyond all integers": lambda header: header["a"].update(shape=[10**400]),
    "a shape of many axes": lambda header: header["a"].update(shape=[1] * 10_000),
    "a shape that is a number": lambda header: header["a"].update(shape=6),
    "True in a shape": lambda header: header["b"].update(shape=[4, True]),
    "another dtype": lambda header: header["b"].update(dtype="BF16"),
    "no such dtype": lambda header: header["a"].update(dtype="F7"),
    "a list for a dtype": lambda header: header["a"].update(dtype=["F32"]),
    "no dtype": lambda header: header["a"].pop("dtype"),
    "a text for a tensor": lambda header: header.update(a="tensor"),
    "one tensor more": lambda header: header.update(c=header["a"]),
    "one tensor less": lambda header: header.pop("b"),
    "a list for metadata": lambda header: header.update(__metadata__=[1]),
    "a description that is no JSON": lambda header: header["__metadata__"].update(g3r="{"),
    "a description that is a list": lambda header: header["__metadata__"].update(g3r="[1]"),
    "a description that is a number": lambda header: header["__metadata__"].update(g3r=5),
    "a description without an end": lambda header: header["__metadata__"].update(g3r="[" * 100_000),
}


@pytest.mark.parametrize("name", LIES)
def test_a_header_that_lies_is_refused_before_the_file_is_read(name: str, file: Path) -> None:
    file.write_bytes(change_header(file.read_bytes(), LIES[name]))
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"a\.safetensors: is damaged or not written by g3r-export"):
            read_weights(file, "prior")
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "offsets", [[0, 24], [8, 32], [4, 28], [-24, 0], [0, 10**30], [24, 0]], ids=lambda offsets: str(offsets)
)
def test_offsets_that_overlap_or_leave_gaps(offsets: list[int], file: Path) -> None:
    """The safetensors library detects these while it decodes the tensors."""
    file.write_bytes(change_header(file.read_bytes(), lambda header: header["a"].update(data_offsets=offsets)))
    found = read_weights(file, "prior")
    if offsets != found_offsets():
        with pytest.raises(ValueError, match=r"\w"):
            found.tensors()


def found_offsets() -> list[int]:
    whole = save(TENSORS)
    return json.loads(whole[8 : 8 + int.from_bytes(whole[:8], "little")])["a"]["data_offsets"]


BYTES = {
    "empty": (b"", "not a safetensors file"),
    "seven bytes": (b"1234567", "not a safetensors file"),
    "a length alone": (bytes(8), "not a safetensors file"),
    "text": (b"these are no weights\n", "not a safetensors file"),
    "no JSON": (with_header(b"{these are no weights"), "the header is not JSON"),
    "no text": (with_header(b"{\xff\xfe"), "the header is not JSON"),
    "deep JSON": (with_header(b'{"a":' * 50_000), "the header is not JSON"),
    "longer than the file": ((1000).to_bytes(8, "little") + b"{}", "a header of 1000 bytes in a file of 10"),
    "longer than any": ((2**64 - 1).to_bytes(8, "little") + b"{}", "a header of 18446744073709551615 bytes"),
    "too long": (with_header(b"{" + bytes(MAX_HEADER_BYTES)), "a header of 1000001 bytes"),
    "of another program": (save({"a": torch.ones(2)}, {"format": "pt"}), "not written by g3r"),
    "without metadata": (save({"a": torch.ones(2)}), "not written by g3r"),
    "an archive": (b"PK\x03\x04" + bytes(100), "export the run's .ckpt again with g3r-export"),
}


@pytest.mark.parametrize("name", BYTES)
def test_files_that_are_none(name: str, file: Path) -> None:
    content, says = BYTES[name]
    file.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_weights(file, "prior")
    assert str(caught.value).startswith(f"{file}: ")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("n_bytes", [4, 20, -4])
def test_a_file_cut_off_or_continued(n_bytes: int, file: Path) -> None:
    whole = file.read_bytes()
    file.write_bytes(whole[:-n_bytes] if n_bytes > 0 else whole + bytes(-n_bytes))
    with pytest.raises(InputError, match=r"is damaged .* bytes expected, \d+ found"):
        read_weights(file, "prior")


def test_a_sparse_file_of_a_terabyte(file: Path) -> None:
    with file.open("wb") as stream:
        stream.write(with_header(json.dumps({"a": {"dtype": "F32", "shape": [250, 10**9]}}).encode()))
        stream.truncate(10**12)
    with pytest.raises(InputError, match="in a file of 1000000000000"):
        read_weights(file, "prior")


@pytest.mark.parametrize("name", ["missing", "folder", "pipe", "device", "zero byte"])
def test_what_is_no_file(name: str, tmp_path: Path) -> None:
    import os

    path = Path("/dev/zero") if name == "device" else tmp_path / ("a\0b" if name == "zero byte" else "bad")
    if name == "folder":
        path.mkdir()
    elif name == "pipe":
        os.mkfifo(path)
    expected = "no such file; expected a prior checkpoint" if name == "missing" else "cannot be read"
    with pytest.raises(InputError, match=expected):
        read_weights(path, "prior")
