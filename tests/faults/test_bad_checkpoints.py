"""Files that are not networks: refused by the command in one line, and nothing in them is run."""

from __future__ import annotations

import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from g3r.cli import export
from g3r.cli.infer import main
from g3r.errors import InputError
from g3r.prior.model import Prior
from tests.checkpoints.altered_files import (
    change_header,
    content_of,
    small_pose,
    small_prior,
    with_header,
    write_content,
)
from tests.faults.commands import assert_refused, run
from tests.faults.fuzz_checkpoints import Canary
from tests.faults.nifti_files import write
from tests.tally import Tally

pytestmark = pytest.mark.usefixtures("networks_once")

Maker = Callable[[Path], object]


def changed(**entries: Any) -> Maker:
    """A good prior with changed entries."""

    def make(path: Path) -> None:
        small_prior().save(path)
        content = content_of(path)
        arguments = entries.get("network_arguments", {})
        content |= entries | {"network_arguments": content["network_arguments"] | arguments}
        write_content(path, content)

    return make


def claims(**entries: Any) -> Maker:
    """A good prior whose header makes other claims about a tensor."""

    def make(path: Path) -> None:
        small_prior().save(path)
        whole = path.read_bytes()
        path.write_bytes(change_header(whole, lambda header: header["refiner.head.weight"].update(entries)))

    return make


def zeros_unfold(path: Path) -> None:
    """A small archive with an entry that decompresses to 64 MB."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("prior/data.pkl", "w") as entry:
        for _ in range(64):
            entry.write(bytes(2**20))


def first_half(path: Path) -> None:
    small_prior().save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])


def older_format(path: Path, content: object) -> None:
    torch.save(content, path, _use_new_zipfile_serialization=False)


OTHER, ANOTHER = "is not a prior checkpoint .not a safetensors file", "pass a prior network made by g3r-export"
SAVED_BY_TORCH = r"is a file of torch.save .*; export the run's \.ckpt again with g3r-export"
BAD: dict[str, tuple[Maker, str]] = {
    "missing": (lambda path: None, "no such file; expected a prior checkpoint"),
    "folder": (lambda path: path.mkdir(), "cannot be read"),
    "link to itself": (lambda path: path.symlink_to(path.name), "cannot be read"),
    "pipe": (os.mkfifo, "cannot be read .not a regular file"),
    "device": (lambda path: path.symlink_to("/dev/zero"), "cannot be read .not a regular file"),
    "empty": (lambda path: path.write_bytes(b""), OTHER),
    "text": (lambda path: path.write_text("weights\n"), OTHER),
    "stack": (lambda path: path.write_bytes(write(path.with_name("x.nii")).read_bytes()), OTHER),
    "pickle": (lambda path: path.write_bytes(pickle.dumps({"format": "g3r-prior"})), OTHER),
    "older format of torch.save": (lambda path: older_format(path, {"format": "g3r-prior"}), OTHER),
    "weights of an earlier version": (lambda path: torch.save({"format": "g3r-prior"}, path), SAVED_BY_TORCH),
    "training checkpoint": (
        lambda path: torch.save({"pytorch-lightning_version": "2.6", "state_dict": {}}, path),
        SAVED_BY_TORCH,
    ),
    "whole network": (lambda path: torch.save(torch.nn.Linear(2, 2), path), SAVED_BY_TORCH),
    "zip of text": (lambda path: zipfile.ZipFile(path, "w").writestr("a.txt", "hello"), SAVED_BY_TORCH),
    "a bomb": (zeros_unfold, SAVED_BY_TORCH),
    "half of it": (first_half, f"is damaged .*{ANOTHER}"),
    "a header without an end": (lambda path: path.write_bytes(with_header(b'{"a":' * 10**5)), "is damaged"),
    "a header of 2^60 bytes": (lambda path: path.write_bytes((2**60).to_bytes(8, "little") + b"{}"), "is damaged"),
    "a shape of 10 GB": (claims(shape=[50_000, 50_000]), "is damaged .*bytes expected"),
    "another dtype": (claims(dtype="U8"), "has no dtype that g3r writes"),
    "overlapping tensors": (claims(data_offsets=[0, 1]), "do not fit together"),
    "another program's": (lambda path: path.write_bytes(with_header(b"{}")), "not written by g3r"),
    "pose network": (lambda path: small_pose().save(path), "format is 'g3r-pose', expected 'g3r-prior'"),
    "another version": (changed(format_version=1), "format version is 1, this g3r reads 2"),
    "version as a list": (changed(format_version=[2]), "format version is a list"),
    "True for 2": (changed(format_version=True), "format version is True"),
    "huge number": (changed(voxel_mm=10**400), "could not convert voxel_mm a int"),
    "list for a text": (changed(training_data=["x"] * 10**4), "expected a text"),
    "long text": (changed(training_data="x" * 10**5), "expected a text"),
    "a billion units": (changed(network_arguments={"units": [10**9, 1]}), "a prior network needs"),
    "huge channels": (changed(network_arguments={"channels": [10**6, 4]}), "a prior network needs"),
    "beyond all integers": (changed(network_arguments={"channels": [10**400, 4]}), "channels is a list, out of bounds"),
    "wide channels": (changed(network_arguments={"channels": [4096, 4096]}), "do not fit together"),
    "NaN alpha": (changed(network_arguments={"alpha": float("nan")}), "alpha is nan"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_prior(name: str, tmp_path: Path, tally: Tally) -> None:
    make, says = BAD[name]
    stack, bad = write(tmp_path / "stack.nii.gz"), tmp_path / "bad.safetensors"
    make(bad)
    with tally.case() as case:
        line = ["--stacks", stack, "--whole-image", "--ckpt", bad, "--output", tmp_path / "out"]
        assert_refused(run(main, line, tmp_path), "g3r-infer", "bad.safetensors", says)
        case.refused()


@pytest.mark.parametrize("name", ["missing", "text", "half of it", "another program's"])
def test_a_bad_pose_network(name: str, tmp_path: Path, tally: Tally) -> None:
    stack, bad = write(tmp_path / "stack.nii.gz"), tmp_path / "bad.safetensors"
    BAD[name][0](bad)
    with tally.case() as case:
        line = ["--stacks", stack, "--whole-image", "--pose-ckpt", bad, "--output", tmp_path / "out"]
        assert_refused(run(main, line, tmp_path), "g3r-infer", "bad.safetensors", "; pass a pose network")
        case.refused()


WAYS: dict[str, Callable[[Path, Canary], object]] = {
    "bare": lambda path, canary: path.write_bytes(pickle.dumps(canary)),
    "text protocol": lambda path, canary: path.write_bytes(pickle.dumps(canary, protocol=0)),
    "older format": lambda path, canary: older_format(path, {"x": canary}),
    "archive": lambda path, canary: torch.save({"format": "g3r-prior", "x": canary}, path),
    "in place of a header": lambda path, canary: path.write_bytes(with_header(pickle.dumps(canary))),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_program_is_not_run(way: str, tmp_path: Path, tally: Tally) -> None:
    canary, path = Canary(tmp_path / "ran"), tmp_path / "bad.pt"
    WAYS[way](path, canary)
    with tally.case() as case:
        with pytest.raises(InputError, match=r"bad\.pt: is "):
            Prior.load(path)
        assert not canary.folder.exists()
        case.refused()
    with tally.case() as case:
        outcome = run(export.main, [path, tmp_path / "prior.safetensors"], tmp_path)
        assert_refused(outcome, "g3r-export", "bad.pt", "expected a training checkpoint")
        assert not canary.folder.exists()
        case.refused()


def test_the_canary_sings(tmp_path: Path) -> None:
    """Unsafe unpickling of the files above does run their program, so the tests would detect it."""
    canary, path = Canary(tmp_path / "ran"), tmp_path / "bad.pt"
    WAYS["archive"](path, canary)
    torch.load(path, weights_only=False)
    assert canary.folder.is_dir()
    os.rmdir(canary.folder)
    assert pickle.loads(pickle.dumps(canary)) is None
    assert canary.folder.is_dir()
