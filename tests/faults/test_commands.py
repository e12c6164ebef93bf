"""Measures of the fault tests: memory of a command independent of earlier ones, and words of a remedy."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.faults.commands import MAX_BYTES, assert_refused, has_remedy, run

BEFORE = MAX_BYTES + 100_000_000
CLAIMED = MAX_BYTES + 50_000_000

LINE = "g3r-x: bad.nii: has shape (24, 20); expected 3D, split the frames"


def refusal(arguments: list[str]) -> int:
    """A command that allocates the memory claimed by a header before it refuses the file."""
    if "numpy" in arguments:
        np.empty(CLAIMED, np.uint8)  # not touched
    if "torch" in arguments:
        torch.ones(CLAIMED, dtype=torch.uint8)
    print(LINE, file=sys.stderr)
    return 3


def test_memory_is_seen_after_a_test_that_took_more(tmp_path: Path) -> None:
    earlier = np.ones(BEFORE, np.uint8)
    del earlier
    assert_refused(run(refusal, [], tmp_path), "g3r-x", "bad.nii", "shape")
    with pytest.raises(AssertionError, match="gained_bytes"):
        assert_refused(run(refusal, ["numpy"], tmp_path), "g3r-x", "bad.nii", "shape")


def test_memory_of_other_libraries_is_seen(tmp_path: Path) -> None:
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pytest.skip("the peak of a process's memory cannot be reset here")
    earlier = np.ones(BEFORE, np.uint8)
    del earlier
    with pytest.raises(AssertionError, match="gained_bytes"):
        assert_refused(run(refusal, ["torch"], tmp_path), "g3r-x", "bad.nii", "shape")


@pytest.mark.parametrize(
    ("line", "helps"),
    [
        (LINE, True),
        ("a.nii: is a folder; check the path", True),
        ("a.nii: mask is empty, expected the brain to be marked with 1", True),
        ("a.nii: has shape (24, 20, 8)", False),
        ("a.nii: has shape (24, 20, 8); 3", False),
        ("a.nii: bad file, sorry", False),
    ],
)
def test_a_remedy_is_in_words(line: str, helps: bool) -> None:
    assert has_remedy(line) == helps
