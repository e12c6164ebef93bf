"""`python -m studies.masks.real`: brain masks found in real stacks, compared with masks drawn by hand."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from g3r.acquisition.stacks import load_stack
from g3r.errors import InputError
from studies.harness import Record, Row, Study, Task
from studies.masks.overlap import EACH, OPTIONS, line, scored, settings
from studies.subjects import data_folder
from studies.tables import table

MASK_ENDING = "_desc-brain_mask.nii.gz"


def stacks_with_masks() -> list[tuple[Path, Path]]:
    """Stacks of `real/` in the test data with the masks drawn on them.

    Raises:
        InputError: there is none.
    """
    folder = data_folder("real")
    found = []
    for mask in sorted(folder.rglob(f"*{MASK_ENDING}")):
        stack = mask.with_name(mask.name.removesuffix(MASK_ENDING) + ".nii.gz")
        if stack.is_file():
            found.append((stack, mask))
    if not found:
        raise InputError(f"{folder}: no stack with a mask *{MASK_ENDING}; add some, or set G3R_TEST_DATA")
    return found


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """A measurement per stack."""
    for stack, mask in stacks_with_masks():
        yield Task(stack.name.removesuffix(".nii.gz"), measure, (stack, mask, options))


def measure(stack: Path, mask: Path, options: argparse.Namespace) -> Row:
    """One stack.

    Args:
        stack: its file.
        mask: file of the mask drawn by hand.
        options: of the command.
    """
    true = load_stack(stack, mask)  # rows in the order in which the product asks the network, too
    return scored(true.image, true.mask, true.spacing_mm.tolist(), options.masks)


def tables(record: Record) -> dict[str, str]:
    """A row per stack."""
    return {"masks-real": table(({"name": name, **row} for name, row in record["rows"].items()), EACH)}


STUDY = Study(
    name="masks.real",
    about="Find the brain in the real stacks of the test data that have masks drawn by hand.",
    document="masks.md",
    shared=(),
    options=OPTIONS,
    settings=settings,
    tasks=tasks,
    line=line,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
