"""Blocks that studies publish in docs/: text between markers, with its page, command, machine and tables."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from studies.harness import DOCS

PAGE = "results.md"
"""The page that is generated from all others."""

NO_MEASUREMENT = {"messages", "paper-elsewhere"}
"""Blocks without measurements: a list of the program's messages, and rows that repeat another page."""

RECORD_OF = {
    "paper-variants": "paper-methods",
    "paper-variants-atlas": "paper-methods-atlas",
    "paper-stages": "paper-methods",
    "paper-stages-atlas": "paper-methods-atlas",
}
"""Blocks that come from the record of another block, which is the block whose command the page states."""

OLDER_WEIGHTS = {
    *("sets", "unseen-sweep", "masks-written", "paper-variants-atlas", "paper-stages-atlas", "lattices", "in-plane"),
    *("time-budgets", "bias", "convergence", "layers", "intensities", "slice-profile"),
}
"""Blocks measured with earlier weights of the prior, before commit bc1df76, that do not name them. Blocks published
since then do."""

BLOCK = re.compile(r"<!-- ([\w.-]+):begin -->\n(.*?)\n?<!-- \1:end -->", flags=re.DOTALL)
COMMAND = re.compile(
    r"^    ((?:make|g3r-bench|python3? -m) .*)$|`((?:make study-|g3r-bench )[^`]+)`", flags=re.MULTILINE
)
TABLE = re.compile(r"(?:^\|.*(?:\n|\Z))+", flags=re.MULTILINE)
MACHINE = re.compile(r"[^.;|\n]*, \d+ cores, \d+ threads; Python [^;]*; ")
COMMIT = re.compile(r"\b(?:commit|g3r [\d.]+ at) ([0-9a-f]{7,}\+?|unknown)")
WEIGHTS = re.compile(r"\b[Ww]eights ([0-9a-f]{16})\b")
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")

TableRow = Mapping[str, str]


@dataclass(frozen=True)
class Table:
    """A table in Markdown.

    Attributes:
        text: of the table.
        before: text of the block between the previous table and this one.
    """

    text: str
    before: str = ""

    @cached_property
    def rows(self) -> tuple[TableRow, ...]:
        """Cells by column heading; repeated headings get a number."""
        lines = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in self.text.splitlines()]
        heads = [head if head not in lines[0][:n] else f"{head} {n}" for n, head in enumerate(lines[0])]
        return tuple(dict(zip(heads, line, strict=True)) for line in lines[2:])

    def row(self, name: str) -> TableRow | None:
        """The row whose first cell is `name`."""
        return next((row for row in self.rows if next(iter(row.values())) == name), None)


@dataclass(frozen=True)
class Block:
    """A published block of a study.

    Attributes:
        name: of its markers.
        page: file in docs/.
        command: command that measures it; empty if the page states none.
        text: between the markers.
    """

    name: str
    page: str
    command: str
    text: str

    @cached_property
    def tables(self) -> tuple[Table, ...]:
        """All tables, from top to bottom."""
        found, end = [], 0
        for match in TABLE.finditer(self.text):
            found.append(Table(match[0].strip(), self.text[end : match.start()].strip()))
            end = match.end()
        return tuple(found)

    @property
    def commit(self) -> str:
        """Commit of the measurement; empty if the block does not state it."""
        found = COMMIT.findall(self.text)
        return found[-1] if found else ""

    @property
    def machine(self) -> str:
        """Processor, cores and threads; empty if the block does not state them."""
        found = MACHINE.search(self.text)
        return found[0].split(";")[0].strip() if found else ""

    @property
    def weights(self) -> str:
        """Weights of the prior; empty if the block does not state them."""
        found = WEIGHTS.search(self.text)
        return found[1] if found else ""

    def is_older(self, shipped: str) -> bool:
        """Whether it was measured with weights other than `shipped`."""
        return self.weights != shipped if self.weights else self.name in OLDER_WEIGHTS

    @property
    def is_measured(self) -> bool:
        """Whether it has a table with rows."""
        return any(table.rows for table in self.tables)


def published(docs: Path = DOCS) -> dict[str, Block]:
    """Every block of the pages, by name.

    Raises:
        ValueError: two pages have a block of the same name.
    """
    found: dict[str, Block] = {}
    for path in sorted(docs.glob("*.md")):
        text = path.read_text(encoding="utf-8") if path.name != PAGE else ""
        for match in BLOCK.finditer(text):
            name = match[1]
            if name in NO_MEASUREMENT:
                continue
            if name in found:
                raise ValueError(f"{path.name} and {found[name].page} both have a block {name}")
            command = found[RECORD_OF[name]].command if name in RECORD_OF else _command(text[: match.start()])
            found[name] = Block(name, path.name, command, match[2].strip())
    return found


def _command(above: str) -> str:
    """The last command in a text; empty if there is none."""
    whole = BLOCK.sub("", re.sub(r"\s*\\\n\s*", " ", above))
    commands = [indented or inline for indented, inline in COMMAND.findall(whole)]
    return commands[-1].split("  #")[0].strip() if commands else ""


def origin(name: str, blocks: Mapping[str, Block]) -> Block:
    """The block that states machine and commit of a block: itself, or another block of the same record.

    Args:
        name: of the block.
        blocks: all.
    """
    block = blocks[name]
    return block if block.commit else blocks.get(RECORD_OF.get(name, ""), block)


def number(text: str) -> float | None:
    """The first number of a cell, such as the mean of "25.91 ± 0.13"; None where there is none."""
    found = NUMBER.search(text)
    return float(found[0]) if found else None
