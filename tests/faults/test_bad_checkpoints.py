"""Files that are no networks: refused by the command in one line, and nothing in them is run."""

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
from g3r.prior.checkpoint import load_prior
from tests.faults.commands import assert_refused, run
from tests.faults.fuzz_checkpoints import Canary, rewritten, small_pose, small_prior
from tests.faults.nifti_files import write
from tests.tally import Tally

pytestmark = pytest.mark.usefixtures("networks_once")

Maker = Callable[[Path], object]


def changed(**entries: Any) -> Maker:
    """A good prior with other entries."""

    def make(path: Path) -> None:
        content = torch.load(small_prior(path), weights_only=True)
        arguments = entries.pop("network_arguments", {})
        content |= entries
        content["network_arguments"] |= arguments
        torch.save(content, path)

    return make


def packed_again(path: Path) -> None:
    rewritten(small_prior(path), bytes, zipfile.ZIP_DEFLATED)


def zeros_unfold(path: Path) -> None:
    """A small archive with an entry that unfolds to 64 MB."""
    small_prior(path)
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive, archive.open("prior/data/999", "w") as entry:
        for _ in range(64):
            entry.write(bytes(2**20))


def more_than_the_file_holds(path: Path) -> None:
    """Shapes that repeat a few bytes over gigabytes."""
    changed(network_arguments={"channels": [4096, 4096], "units": [8, 8]})(path)
    content = torch.load(path, weights_only=True)
    content["weights"] = {name: torch.zeros(1).expand(4096, 4096, 27) for name in content["weights"]}
    torch.save(content, path)


def first_half(path: Path) -> None:
    whole = small_prior(path).read_bytes()
    path.write_bytes(whole[: len(whole) // 2])


PICKLED, ANOTHER = "not a prior checkpoint .not a file of torch.save", "pass a file made by g3r-export"
BAD: dict[str, tuple[Maker, str]] = {
    "missing": (lambda path: None, "no such file; expected a prior checkpoint"),
    "folder": (lambda path: path.mkdir(), "cannot be read"),
    "link to itself": (lambda path: path.symlink_to(path.name), "cannot be read"),
    "empty": (lambda path: path.write_bytes(b""), PICKLED),
    "text": (lambda path: path.write_text("weights\n"), PICKLED),
    "stack": (lambda path: path.write_bytes(write(path.with_name("x.nii")).read_bytes()), PICKLED),
    "pickle": (lambda path: path.write_bytes(pickle.dumps({"format": "g3r-prior"})), PICKLED),
    "older format": (
        lambda path: torch.save({"format": "g3r-prior"}, path, _use_new_zipfile_serialization=False),
        PICKLED,
    ),
    "half of it": (first_half, f"is damaged .*{ANOTHER}"),
    "zip of text": (lambda path: zipfile.ZipFile(path, "w").writestr("a.txt", "hello"), "is damaged"),
    "packed": (packed_again, "is damaged"),
    "a bomb": (zeros_unfold, "is damaged"),
    "tensor": (lambda path: torch.save(torch.zeros(3), path), "holds a Tensor"),
    "whole network": (lambda path: torch.save(torch.nn.Linear(2, 2), path), "it names 'torch.nn"),
    "pose network": (small_pose, "format is 'g3r-pose', expected 'g3r-prior'"),
    "training checkpoint": (
        lambda path: torch.save({"pytorch-lightning_version": "2.6", "state_dict": {}}, path),
        "g3r-export",
    ),
    "another version": (changed(format_version=2), "format version is 2, this g3r reads 1"),
    "version as a tensor": (changed(format_version=torch.ones(3)), "format version is a Tensor"),
    "True for 1": (changed(format_version=True), "format version is True"),
    "huge number": (changed(voxel_mm=10**400), "could not convert voxel_mm a int"),
    "tensor for a text": (changed(training_data=torch.zeros(1).expand(10**6, 10**6)), "expected a text"),
    "a billion units": (changed(network_arguments={"units": [10**9, 1]}), "units is a list, out of bounds"),
    "huge channels": (changed(network_arguments={"channels": [10**6, 4]}), "channels is a list, out of"),
    "more than it holds": (more_than_the_file_holds, "claims more values than the file holds"),
    "wide channels": (changed(network_arguments={"channels": [4096, 4096]}), "do not fit together"),
    "NaN alpha": (changed(alpha=float("nan"), network_arguments={"alpha": float("nan")}), "alpha is nan"),
    "another voxel size": (small_prior, "was trained on voxels of 0.8 mm, expected 1 mm"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_prior(name: str, tmp_path: Path, tally: Tally):
    make, says = BAD[name]
    stack, bad = write(tmp_path / "stack.nii.gz"), tmp_path / "bad.pt"
    make(bad)
    options = ["--prior-voxel", "1"] if name == "another voxel size" else []
    with tally.case() as case:
        line = ["--stacks", stack, "--ckpt", bad, "--output", tmp_path / "out", *options]
        assert_refused(run(main, line, tmp_path), "g3r-infer", "bad.pt", says)
        case.refused()


@pytest.mark.parametrize("name", ["missing", "text", "half of it", "tensor"])
def test_a_bad_pose_network(name: str, tmp_path: Path, tally: Tally):
    stack, bad = write(tmp_path / "stack.nii.gz"), tmp_path / "bad.pt"
    BAD[name][0](bad)
    with tally.case() as case:
        line = ["--stacks", stack, "--pose-ckpt", bad, "--output", tmp_path / "out"]
        assert_refused(run(main, line, tmp_path), "g3r-infer", "bad.pt", "; pass a ")
        case.refused()


WAYS: dict[str, Callable[[Path, Canary], object]] = {
    "bare": lambda path, canary: path.write_bytes(pickle.dumps(canary)),
    "older format": lambda path, canary: torch.save({"x": canary}, path, _use_new_zipfile_serialization=False),
    "archive": lambda path, canary: torch.save({"format": "g3r-prior", "x": canary}, path),
    "whole pickle": lambda path, canary: rewritten(small_prior(path), lambda _: pickle.dumps(canary)),
    "text protocol": lambda path, canary: rewritten(small_prior(path), lambda _: pickle.dumps(canary, protocol=0)),
    "newest protocol": lambda path, canary: rewritten(small_prior(path), lambda _: pickle.dumps(canary, protocol=5)),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_program_is_not_run(way: str, tmp_path: Path, tally: Tally):
    canary, path = Canary(tmp_path / "ran"), tmp_path / "bad.pt"
    WAYS[way](path, canary)
    with tally.case() as case:
        with pytest.raises(InputError, match=r"bad\.pt: is "):
            load_prior(path)
        assert not canary.folder.exists()
        case.refused()
    with tally.case() as case:
        outcome = run(export.main, [path, tmp_path / "prior.pt"], tmp_path)
        assert_refused(outcome, "g3r-export", "bad.pt", "expected a training checkpoint")
        assert not canary.folder.exists()
        case.refused()


def test_the_canary_sings(tmp_path: Path):
    """Unpickled without care, the files above do run their program: the tests would see it."""
    canary, path = Canary(tmp_path / "ran"), tmp_path / "bad.pt"
    WAYS["archive"](path, canary)
    torch.load(path, weights_only=False)
    assert canary.folder.is_dir()
    os.rmdir(canary.folder)
    assert pickle.loads(pickle.dumps(canary)) is None
    assert canary.folder.is_dir()
