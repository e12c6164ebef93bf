"""Figures that stand in several documents are the same in all of them, and follow from what was measured."""

from __future__ import annotations

import re
from statistics import mean

from tests.report import messages_table
from tests.rooms import REPOSITORY

Rows = list[dict[str, str]]


def text_of(name: str) -> str:
    return (REPOSITORY / name).read_text(encoding="utf-8")


def rows(text: str) -> Rows:
    """The first table of a text; columns of one name get a number (as the tables of docs/tradeoff.md have "CPU s")."""
    lines = re.search(r"(^\|.*\n)+", text, flags=re.MULTILINE)
    assert lines
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[0].splitlines()]
    heads = [head if head not in cells[0][:n] else f"{head} {n}" for n, head in enumerate(cells[0])]
    return [dict(zip(heads, line, strict=True)) for line in cells[2:]]


def marked(name: str, marker: str) -> Rows:
    """The first table between markers of a document."""
    return rows(text_of(name).split(f"<!-- {marker}:begin -->")[1].split(f"<!-- {marker}:end -->")[0])


def test_the_presets_in_the_readme_are_means_of_the_subjects() -> None:
    shown = rows(text_of("README.md").split("## Speed against accuracy")[1])
    three = [row for row in marked("docs/tradeoff.md", "presets") if row["`fast`, dB"]]
    fewer = marked("docs/tradeoff.md", "fewer-stacks")
    seconds = [head for head in three[0] if head.startswith("CPU s")]
    for row, column in zip(shown, seconds, strict=True):
        name = row["preset"]
        two = [one for one in fewer if one["preset"] == name and one["stacks"] == "2"]
        assert float(row["three stacks, dB"]) == round(mean(float(one[f"{name}, dB"]) for one in three), 1)
        found = [mean(float(one[column]) for one in three)]
        if two:
            assert float(row["two stacks, dB"]) == round(mean(float(one["volume"]) for one in two), 1)
            found.append(mean(float(one["CPU s"]) for one in two))
        assert row["CPU seconds, three and two"] == ", ".join(f"{one:.0f}" for one in found)
    assert len(three) == 8
    sizes = [[float(one) for one in row["pixel x slice, mm"].split(" x ")] for row in three]
    ranges = [f"{min(column):g} to {max(column):g} mm" for column in zip(*sizes, strict=True)]
    assert f"pixels of {ranges[0]}, slices of {ranges[1]}" in " ".join(text_of("README.md").split())
    assert "eight simulated subjects" in text_of("README.md")


def test_other_programs_are_compared_with_what_was_measured() -> None:
    measured = {row["preset"]: row for row in marked("docs/tradeoff.md", "trade") if row["case"] == "sta30-moderate"}
    peers = {row["method"]: row for row in marked("docs/peers.md", "peers")}
    for preset in ("`fast`", "`balanced`"):
        one, shown = measured[preset], peers[f"g3r {preset}"]
        assert shown["PSNR, dB"] == one["PSNR, dB"]
        assert shown["SSIM"] == f"{float(one['SSIM']):.3f}"
        assert shown["CPU seconds"] == f"{float(one['CPU seconds']):.0f}"


def test_the_readme_repeats_that_comparison() -> None:
    peers = {name.split(",")[0]: row for name, row in ((r["method"], r) for r in marked("docs/peers.md", "peers"))}
    for row in rows(text_of("README.md").split("## Beside other programs")[1]):
        source = peers[row[""].split(",")[0]]
        assert all(row[head] == source[head] for head in ("PSNR, dB", "SSIM", "CPU seconds"))


def test_the_readme_is_short() -> None:
    assert len(text_of("README.md").splitlines()) < 120


def test_every_message_of_the_verdict_is_explained() -> None:
    """`python -m tests.report.messages_table` writes the table."""
    assert messages_table.table() in text_of("docs/report.md")
