"""A case that is reconstructed in about a second, as a command or in processes that are killed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from g3r.cli.infer import main as infer
from g3r.output.record import CommandRecord, Inputs, RunRecord
from g3r.output.stack_record import StackRecord
from g3r.planning.presets import ReconstructionSettings
from g3r.run.provenance import FileHash
from tests.phantoms import simulate_small_subject
from tests.quick import QUICK_FIT

FOLDER = Path(__file__).parent

WHOLE = {
    "volume.nii.gz",
    "mask.nii.gz",
    "prior.nii.gz",
    "coarse.nii.gz",
    "density.nii.gz",
    "uncertainty.nii.gz",
    "unseen.nii.gz",
    "gaussians.npz",
    "reuse.npz",
    "slices.tsv",
    "run.json",
    "sections.png",
    "report.html",
    "log.txt",
}
"""Files of a result without a prior network."""

BY_COMMAND = {"log.txt"}
"""Files that the command adds to those of a saved result."""


@dataclass(frozen=True)
class SmallCase:
    """Three small stacks, a run.json with settings for a quick run, and the resulting volume."""

    folder: Path
    config: Path
    volume: bytes

    def arguments(self, output: Path, *further: str) -> list[str]:
        """Arguments of g3r-infer for the quick run."""
        return [
            "--stacks",
            *self.files("stack"),
            "--masks",
            *self.files("mask"),
            "--config",
            str(self.config),
            "--quiet",
            "--output",
            str(output),
            *further,
        ]

    def files(self, kind: str) -> list[str]:
        """Files of the stacks or masks."""
        return [str(self.folder / f"{kind}-{n}.nii.gz") for n in range(3)]

    def run(self, output: Path, *further: str) -> int:
        """Run the quick run in this process; returns its exit code."""
        return infer(self.arguments(output, *further))


def quick_settings() -> ReconstructionSettings:
    """Settings for a run of about a second."""
    registration = replace(
        QUICK_FIT.registration,
        template=False,
        network=False,
        stacks=False,
        segments=False,
        n_rounds=1,
        standard_orientation=False,
    )  # the poses do not matter here, so registration is a fraction of a second
    return replace(QUICK_FIT, registration=registration, resolution_mm=2.0, use_prior=False)


def make_small_case(folder: Path) -> SmallCase:
    """Simulate the stacks, write a run.json with the quick settings, and run once to get the volume."""
    simulate_small_subject(folder / "stacks", "--seed", "61001")
    case = SmallCase(folder / "stacks", folder / "run.json", b"")
    stacks, masks = (tuple(map(FileHash.of, case.files(kind))) for kind in ("stack", "mask"))
    record = RunRecord(
        settings=quick_settings(),
        inputs=Inputs(stacks=stacks, masks=masks),
        stacks=[StackRecord(name=stack.name, thickness_mm=4.0) for stack in stacks],
        command=CommandRecord(stacks=[], preset=None, seed=0, threads=1, space="scanner"),
    )
    case.config.write_text(record.to_json())
    assert case.run(folder / "out") == 0
    return replace(case, volume=(folder / "out" / "volume.nii.gz").read_bytes())


def names(folder: Path) -> set[str]:
    """Names of the entries of a folder."""
    return {path.name for path in folder.iterdir()}


Killed = Callable[..., dict[str, Any]]


@contextmanager
def fork_server() -> Iterator[Killed]:
    """Start a fork server; returns a function that runs g3r-infer with arguments, kill_after_s and signal."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = os.pathsep.join([str(FOLDER.parents[1]), os.environ.get("PYTHONPATH", "")])
    with subprocess.Popen(
        [sys.executable, str(FOLDER / "fork_server.py")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    ) as server:
        assert server.stdin is not None
        assert server.stdout is not None
        write, read = server.stdin, server.stdout

        def run(arguments: list[str], **request: Any) -> dict[str, Any]:
            with suppress(BrokenPipeError):
                print(json.dumps({"arguments": arguments, **request}), file=write, flush=True)
            answer = read.readline()
            assert answer, "the server has ended"
            return json.loads(answer)

        yield run
        write.close()
