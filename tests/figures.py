"""Tables of README.md and docs/ that repeat measured figures; `python -m tests.figures` writes them all.

They are derived from the tables of docs/tradeoff.md, which studies measure, and from the verdict's message table.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from statistics import mean

from g3r.bench.record import markdown_table, put_between_markers
from tests.report import messages_table
from tests.rooms import REPOSITORY

Rows = list[dict[str, str]]

README, DOCS = REPOSITORY / "README.md", REPOSITORY / "docs"
PEERS, PAPER, TRADEOFF = DOCS / "peers.md", DOCS / "paper.md", DOCS / "tradeoff.md"

WHAT = {
    "`preview`": "least squares alone, without networks, fit and maps",
    "`fast`": "a shorter registration, one fit",
    "`balanced`": "measured slice profiles; two rounds of poses and volume for two stacks",
    "`accurate`": "the mean of six fits; a round of poses and volume, two for two stacks",
}
"""Descriptions of the presets, in the order of the table."""

CASE = "sta30-moderate"

NESVOR = ("NeSVoR 0.6.0rc1", "`--registration stack`, 4,000 iterations", "22.31", "0.929", "474")
"""Measured once, by hand, on that case: name, settings, PSNR in dB, SSIM, CPU seconds. docs/peers.md says how."""


def rows(text: str) -> Rows:
    """The first table of a text; repeated headings get a number."""
    lines = re.search(r"(^\|.*\n?)+", text, flags=re.MULTILINE)
    assert lines
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[0].splitlines()]
    heads = [head if head not in cells[0][:n] else f"{head} {n}" for n, head in enumerate(cells[0])]
    return [dict(zip(heads, line, strict=True)) for line in cells[2:]]


def marked(path: Path, marker: str) -> Rows:
    """The first table between markers of a document."""
    text = path.read_text(encoding="utf-8")
    return rows(text.split(f"<!-- {marker}:begin -->")[1].split(f"<!-- {marker}:end -->")[0])


def subjects() -> Rows:
    """The subjects that were not used to choose settings, with three stacks."""
    return [row for row in marked(TRADEOFF, "presets") if row["`preview`, dB"]]


def presets_table() -> str:
    """Means over the subjects, a row for each preset."""
    three, fewer = subjects(), marked(TRADEOFF, "fewer-stacks")
    seconds = [head for head in three[0] if head.startswith("CPU s")]
    lines = []
    for (name, what), column in zip(WHAT.items(), seconds, strict=True):
        two = [row for row in fewer if row["preset"] == name and row["stacks"] == "2"]
        two = two if len(two) == len(three) else []  # a mean over only some subjects would not be comparable
        took = [three_of[column] for three_of in three], [row["CPU s"] for row in two]
        lines.append(
            [
                name,
                _mean([row[f"{name}, dB"] for row in three], 1),
                _mean([row["volume"] for row in two], 1),
                ", ".join(_mean(one, 0) for one in took if one),
                what,
            ]
        )
    heads = ["preset", "three stacks, dB", "two stacks, dB", "CPU seconds, three and two", "what it does"]
    return _left(markdown_table(heads, lines))


def _mean(texts: list[str], digits: int) -> str:
    return f"{mean(map(float, texts)):.{digits}f}" if texts else ""


def _left(table: str) -> str:
    """The table with all columns left-aligned."""
    return table.replace("---:", "---")


def measured(preset: str) -> list[str]:
    """PSNR, SSIM and CPU seconds of a preset on `CASE`."""
    (row,) = [row for row in marked(TRADEOFF, "trade") if row["case"] == CASE and row["preset"] == preset]
    return [row["PSNR, dB"], f"{float(row['SSIM']):.3f}", f"{float(row['CPU seconds']):.0f}"]


def peers_table(presets: Sequence[str] = ("`fast`", "`balanced`")) -> str:
    """Table of g3r and another program on one case."""
    lines = [[f"{NESVOR[0]}, {NESVOR[1]}", *NESVOR[2:]]]
    lines += [[f"g3r {preset}", *measured(preset)] for preset in presets]
    return markdown_table(["method", "PSNR, dB", "SSIM", "CPU seconds"], lines)


def elsewhere_table() -> str:
    """Table of the other program alone."""
    return peers_table(())


def short_peers_table() -> str:
    """Short table of g3r and the other program for the README, with the most important facts."""
    asked = ["DICOM in and out", "tells when not to use it", "other organs", "validated on patients"]
    lines = [
        ["g3r `balanced`", *measured("`balanced`"), "yes", "yes", "rigid ones", "**no**"],
        [f"{NESVOR[0]}, settings for a CPU", *NESVOR[2:], "no", "no", "yes", "published studies"],
    ]
    return _left(markdown_table(["", "PSNR, dB", "SSIM", "CPU seconds", *asked], lines))


TABLES = {
    (README, "presets"): presets_table,
    (README, "peers"): short_peers_table,
    (PEERS, "peers"): peers_table,
    (PAPER, "paper-elsewhere"): elsewhere_table,
    (messages_table.DOCUMENT, messages_table.MARKER): messages_table.table,
}
"""Functions that make the tables, by document and marker."""


if __name__ == "__main__":
    for (path, marker), table in TABLES.items():
        put_between_markers(path, marker, table())
