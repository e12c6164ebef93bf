"""`g3r-simulate`, `g3r-export`, `g3r-bench` with bad files, and all commands as processes: never a traceback."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch

from data_synth import cli as simulate
from g3r.cli import bench, export
from g3r.cli.infer import main as infer
from g3r.prior.model import Prior
from tests.faults.bad_files import BAD_STACKS, USABLE_AS_A_VOLUME
from tests.faults.commands import assert_refused, run
from tests.faults.nifti_files import ball, write
from tests.tally import Tally


@pytest.fixture(autouse=True, scope="module")
def everything_is_imported() -> None:
    """Import lazily loaded modules first, because that takes seconds which these tests must not measure."""
    for module in ("data_synth.export", "data_synth.phantom", "data_synth.simulator", "g3r.pose_network.network"):
        import_module(module)
    import_module("g3r.prior.dgpn")


@pytest.mark.parametrize("name", BAD_STACKS)
def test_simulate_refuses_a_bad_volume_in_one_line(name: str, tmp_path: Path, tally: Tally) -> None:
    if name in USABLE_AS_A_VOLUME:
        pytest.skip("usable as a volume, and slicing it takes seconds")
    make, says = BAD_STACKS[name]
    (tmp_path / "bad files").mkdir()
    bad = make(tmp_path / "bad files")
    with tally.case() as case:
        line = ["--volume", bad, "--mask", write(tmp_path / "m.nii", ball()), "--output", tmp_path / "out"]
        outcome = run(simulate.main, line, tmp_path)
        assert_refused(outcome, "g3r-simulate", bad.name.replace("\0", "\\x00"), says)
        case.refused()


@pytest.mark.parametrize(
    "option",
    [
        "--resolution=0",
        "--resolution=-1",
        "--resolution=nan",
        "--thickness=0",
        "--thickness=nan",
        "--gap=-9",
        "--gap=nan",
        "--snr=0",
        "--snr=nan",
        "--snr=-3",
        "--bias=nan",
        "--gain=nan",
        "--gain=-1",
        "--phantom=5",
        "--phantom=nan",
        "--phantom=1e9",
        "--seed=-1",
        "--stacks=0",
        "--motion=wild",
        "--stacks=many",
    ],
)
def test_simulate_with_a_value_without_meaning(option: str, tmp_path: Path, tally: Tally) -> None:
    with tally.case() as case:
        source = [] if option.startswith("--phantom") else ["--phantom", "22"]
        outcome = run(simulate.main, [*source, option, "--output", tmp_path / "out"], tmp_path)
        assert outcome.code in (2, 3), outcome
        assert outcome.changed == set()
        assert outcome.code == 2 or len(outcome.err.splitlines()) == 1, outcome.err
        case.refused()


SAID: dict[str, Any] = {
    "kind": "prior",
    "training_data": "",
    "optimiser_steps": 1,
    "conventions": dict(Prior.conventions),
}
RUNS: dict[str, Any] = {
    "missing": None,
    "empty": b"",
    "text": b"weights\n",
    "zip": b"PK\x03\x04" + bytes(100),
    "plain values": {"state_dict": {}},
    "nothing in it": {"state_dict": {}, "g3r_export": {}},
    "text for a description": {"state_dict": {}, "g3r_export": "prior"},
    "text for weights": {"state_dict": {"network.a": "heavy"}, "g3r_export": SAID},
    "list of weights": {"state_dict": [1], "g3r_export": {**SAID, "kind": "pose"}},
    "a list": [1, 2],
    "a tensor": torch.zeros(2),
    "huge numbers": {
        "state_dict": {"network.a": torch.zeros(1)},
        "g3r_export": {**SAID, "validation": {}, "network_arguments": {"channels": 10**400}},
    },
}


@pytest.mark.parametrize("name", RUNS)
def test_export_refuses_a_bad_checkpoint_in_one_line(name: str, tmp_path: Path, tally: Tally) -> None:
    path, content = tmp_path / "last.ckpt", RUNS[name]
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with tally.case() as case:
        outcome = run(export.main, [path, tmp_path / "prior.safetensors"], tmp_path)
        assert_refused(outcome, "g3r-export", "last.ckpt", "expected a training checkpoint|use another checkpoint")
        case.refused()


@pytest.mark.parametrize("content", [None, b"", b"{", b"[1]", b'{"thickness_mm": "thick"}', b'{"thickness": []}'])
def test_bench_of_a_broken_case(content: bytes | None, tmp_path: Path, tally: Tally) -> None:
    folder = tmp_path / "case"
    folder.mkdir()
    if content is not None:
        write(folder / "stack-0.nii.gz")
        write(folder / "mask-0.nii.gz", ball())
        (folder / "simulation.json").write_bytes(content)
    with tally.case() as case:
        outcome = run(bench.main, ["trade", folder, "--output", tmp_path / "out"], folder)
        assert outcome.code == 3, outcome
        assert len(outcome.err.splitlines()) == 1, outcome.err
        case.refused()


REAL = {
    "infer": (["--stacks", "bad.nii.gz", "--output", "out"], 3),
    "evaluate": (["--volume", "bad.nii.gz", "--reference", "good.nii", "--mask", "good.nii"], 3),
    "simulate": (["--volume", "bad.nii.gz", "--mask", "good.nii", "--output", "out"], 3),
    "export": (["bad.nii.gz", "out.safetensors"], 3),
    "pretrain": (["fit", "--config", "bad.nii.gz"], 2),
}


@pytest.mark.faults
@pytest.mark.parametrize("command", REAL)
def test_as_a_process(command: str, tmp_path: Path, tally: Tally) -> None:
    """The exit code as seen by a shell, within five CPU seconds."""
    write(tmp_path / "good.nii")
    (tmp_path / "bad.nii.gz").write_bytes(b"no image\n")
    words, code = REAL[command]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tally.case() as case:
        module = "data_synth.cli" if command == "simulate" else f"g3r.cli.{command}"
        line = [sys.executable, "-m", module, *words]
        root = Path(infer.__code__.co_filename).parents[2]
        done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False, env=_environment(root))
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert done.returncode == code, done.stderr
        assert "Traceback" not in done.stderr
        assert code == 2 or len(done.stderr.splitlines()) == 1, done.stderr
        assert {path.name for path in tmp_path.iterdir()} == {"good.nii", "bad.nii.gz"}
        seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        assert command == "pretrain" or seconds < 5, f"{seconds:.1f} s of CPU time"
        case.refused()


def _environment(root: Path) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
