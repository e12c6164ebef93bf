"""Thousands of damaged NIfTI files and checkpoints: each loads correctly or raises `InputError`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.faults.fuzz import KINDS, run_cases
from tests.tally import Tally

FEW, MANY = 300, 10_000
SEED = 20_261


@pytest.mark.parametrize("kind", KINDS)
def test_a_few_hundred_cases(kind: str, tmp_path: Path, tally: Tally) -> None:
    counts = run_cases(kind, FEW, SEED, tmp_path)
    assert not counts["failures"], "\n".join(counts["failures"])
    assert counts["survived"] + counts["refused"] == counts["tried"] == FEW
    assert counts["survived"] > FEW / 20, "hardly a file was read: the damage is too coarse to test anything"
    assert counts["refused"] > FEW / 5, "hardly a file was refused"
    tally.add(counts["tried"], counts["survived"], counts["refused"])


@pytest.mark.faults
@pytest.mark.parametrize("kind", KINDS)
def test_ten_thousand_cases_with_bounded_memory(kind: str, tally: Tally) -> None:
    """The cases run in a separate process, which a crash of the interpreter, a hang or lack of memory would end."""
    line = [sys.executable, "-m", "tests.faults.fuzz", kind, str(MANY), str(SEED + 1)]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=400, cwd=Path(__file__).parents[2])
    if done.returncode:
        tally.add(MANY)
    assert done.returncode == 0, done.stderr[-3000:]
    counts = json.loads(done.stdout.splitlines()[-1])
    tally.add(counts["tried"], counts["survived"], counts["refused"])
    assert not counts["failures"], "\n".join(counts["failures"])
    assert counts["survived"] + counts["refused"] == counts["tried"] == MANY
