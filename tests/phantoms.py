"""Simulated subjects that tests of several rooms reconstruct."""

from __future__ import annotations

from pathlib import Path

SMALL_SUBJECT = ("--phantom", "22", "--resolution", "1.5", "--thickness", "4", "--motion", "mild")
"""Options of g3r-simulate for three small stacks of a slightly moving brain."""


def simulate_small_subject(folder: Path, *further: str) -> Path:
    """Write the small subject as g3r-simulate does, and return its folder."""
    from data_synth.cli import main

    assert main([*SMALL_SUBJECT, *further, "--output", str(folder)]) == 0
    return folder
