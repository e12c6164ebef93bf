"""Runner of fuzz cases: in the test's process, or many cases in a separate process with bounded memory.

python -m tests.faults.fuzz headers 10000 1        # prints a line of JSON with the counts
"""

from __future__ import annotations

import json
import logging
import resource
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from g3r.errors import InputError
from tests.faults.commands import TooSlowError, has_remedy, within

MAX_SECONDS = 5.0
MAX_GAINED_BYTES = 1_500_000_000
"""Limit of address space, beyond that of the process after all imports."""

MAX_TOLD = 20
"""Number of failures that are described; all are counted."""


class Fuzz(Protocol):
    """Fuzz cases by number."""

    def run(self, number: int) -> None:
        """Run one case: return, or raise `InputError`."""


def header_fuzz(folder: Path, seed: int) -> Fuzz:
    from tests.faults.fuzz_headers import HeaderFuzz

    return HeaderFuzz(folder, seed)


def checkpoint_fuzz(folder: Path, seed: int) -> Fuzz:
    from tests.faults.fuzz_checkpoints import CheckpointFuzz

    return CheckpointFuzz(folder, seed)


KINDS: dict[str, Callable[[Path, int], Fuzz]] = {"headers": header_fuzz, "checkpoints": checkpoint_fuzz}


def run_cases(kind: str, n_cases: int, seed: int, folder: Path, first: int = 0) -> dict[str, Any]:
    """Run cases and count: tried, survived (loaded), refused (one line of `InputError`), failures."""
    logging.disable(logging.WARNING)
    fuzz = KINDS[kind](folder, seed)
    counts: dict[str, Any] = {"tried": 0, "survived": 0, "refused": 0, "failures": []}
    try:
        for number in range(first, first + n_cases):
            counts["tried"] += 1
            try:
                with within(MAX_SECONDS):
                    fuzz.run(number)
                counts["survived"] += 1
            except InputError as error:
                if is_one_line(str(error)):
                    counts["refused"] += 1
                elif len(counts["failures"]) < MAX_TOLD:
                    counts["failures"].append(f"case {number}: no good line: {error!s:.300}")
            except (Exception, TooSlowError):
                if len(counts["failures"]) < MAX_TOLD:
                    counts["failures"].append(f"case {number}: {traceback.format_exc(limit=-4)}")
    finally:
        logging.disable(logging.NOTSET)
    return counts


def is_one_line(message: str) -> bool:
    """Whether a refusal has a name, the finding and a remedy in one readable line."""
    return ": " in message and has_remedy(message) and "\n" not in message and len(message) < 600


def main() -> None:
    """Run the cases of the command line with a memory limit."""
    kind, n_cases, seed = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    with tempfile.TemporaryDirectory() as folder:
        run_cases(kind, 20, seed, Path(folder), first=10**6)  # imports and compiles
        held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        limit = held + MAX_GAINED_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        print(json.dumps(run_cases(kind, n_cases, seed, Path(folder))))


if __name__ == "__main__":
    main()
