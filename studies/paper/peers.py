"""Other programs on the same subjects: a command with placeholders for the files, and the volume that it writes.

    --peer nesvor='nesvor reconstruct --input-stacks {stacks} --stack-masks {masks} --thicknesses {thicknesses}
                   --output-volume {output}'

The command runs without a shell, in its own folder. The files are those of the simulated subject.
"""

from __future__ import annotations

import argparse
import resource
import shlex
import string
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from g3r.acquisition.images import load_volume
from g3r.errors import G3RError, InputError
from studies.harness import Row
from studies.paper.scores import metric, scored
from studies.paper.subjects import PaperSubject, paper_case
from studies.runs import header_error

PLACES = ("stacks", "masks", "thicknesses", "output")

TAIL_LINES = 3
"""Number of last lines printed by a failed program that are kept in the record."""


@dataclass(frozen=True)
class Peer:
    """A program: its name in the tables and its command."""

    name: str
    command: str


def peer(text: str) -> Peer:
    """Option type: NAME=COMMAND.

    Raises:
        argparse.ArgumentTypeError: no name, no {stacks} or {output}, or a placeholder that is not in `PLACES`.
    """
    name, sign, command = text.partition("=")
    try:
        found = {field for _, field, _, _ in string.Formatter().parse(command) if field is not None}
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{command}: {error}") from None
    if not (sign and name.strip() and {"stacks", "output"} <= found <= set(PLACES)):
        raise argparse.ArgumentTypeError(f"{text}; expected NAME='command with {{stacks}} ... {{output}}'")
    return Peer(name.strip(), command)


def arguments(one: Peer, folder: Path, n_stacks: int, thickness_mm: float, output: Path) -> list[str]:
    """The words of a program's command line; a placeholder that is a word by itself becomes one word per file.

    Args:
        one: the program.
        folder: of the simulated subject.
        n_stacks: number of its first stacks to use.
        thickness_mm: of its slices.
        output: where the volume is expected.
    """
    numbers = range(n_stacks)
    values = {
        "stacks": [str(folder / f"stack-{n}.nii.gz") for n in numbers],
        "masks": [str(folder / f"mask-{n}.nii.gz") for n in numbers],
        "thicknesses": [f"{thickness_mm:g}"] * n_stacks,
        "output": [str(output)],
    }
    words: list[str] = []
    for word in shlex.split(one.command):
        alone = values.get(word[1:-1]) if word.startswith("{") and word.endswith("}") else None
        words += alone or [word.format(**{name: " ".join(listed) for name, listed in values.items()})]
    return words


def measure_peer(spec: PaperSubject, n_stacks: int, one: Peer, options: argparse.Namespace) -> Row:
    """Measure another program on one subject; "skipped" holds the reason if it writes no volume.

    Args:
        spec: the subject.
        n_stacks: number of its first stacks to use.
        one: the program.
        options: of the command.
    """
    case = paper_case(spec, options.atlas, options.cache, n_stacks)
    row: Row = {"subject": spec.name, "motion": spec.motion, "n_stacks": n_stacks, "kind": "methods"}
    row |= {"peer": one.name, "command": one.command}
    with tempfile.TemporaryDirectory() as scratch:
        output = Path(scratch) / "volume.nii.gz"
        words = arguments(one, case.folder.resolve(), n_stacks, case.stacks[0].thickness_mm, output)
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        try:
            _run(words, Path(scratch), options.peer_timeout)
            seconds = time.perf_counter() - start
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            volume = load_volume(output)
            lpips = metric(options.lpips_weights) if options.with_lpips else None
            common = header_error(case).common
            # a program may give the head any orientation
            scores, _ = scored(case, volume.data, volume.grid, common, lpips, near=False)
        except G3RError as error:
            print(f"{one.name}, {spec.name}, {n_stacks}: {error}", flush=True)
            return row | {"skipped": str(error)}
    cpu_seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return row | {"scores": {one.name: scores | {"seconds": round(seconds, 2)}}, "cpu_seconds": round(cpu_seconds, 1)}


def _run(words: list[str], folder: Path, timeout_s: float) -> None:
    """Run a program to its end.

    Raises:
        InputError: the program does not exist, failed, or took too long.
    """
    try:
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=timeout_s, check=False)
    except OSError as error:
        raise InputError(f"{words[0]}: cannot be run ({error.strerror}); install it, or change --peer") from None
    except subprocess.TimeoutExpired:
        raise InputError(f"{words[0]}: not done after {timeout_s:g} s; raise --peer-timeout") from None
    if done.returncode:
        said = " | ".join((done.stderr or done.stdout).strip().splitlines()[-TAIL_LINES:])
        raise InputError(f"{words[0]}: ended with {done.returncode} ({said}); change --peer")
