"""The series of a folder as a table for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from g3r.dicom.choice import Judged

HEADINGS = ("series", "description", "plane", "slices", "thickness + gap, mm", "taken")

MAX_DESCRIPTION = 32

HIDDEN = "(descriptions are shown on a terminal only: they may name the patient)"


def table_of(verdicts: Sequence[Judged], *, descriptions: bool) -> str:
    """The text of the table, one line per series.

    Args:
        verdicts: decisions on all series of a folder.
        descriptions: whether the descriptions by the scanner's operator are shown.
    """
    rows = [HEADINGS, *(_row(one, descriptions=descriptions) for one in verdicts)]
    columns = list(zip(*rows, strict=True))
    if not descriptions:
        del columns[HEADINGS.index("description")]
    widths = [max(map(len, column)) for column in columns]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in zip(*columns, strict=True)
    ]
    return "\n".join(lines if descriptions else [*lines, HIDDEN])


def _row(one: Judged, *, descriptions: bool) -> tuple[str, ...]:
    series = one.series
    spacing_mm, thickness_mm = series.spacing_mm, series.thickness_mm
    lengths = "-" if thickness_mm is None else f"{thickness_mm:.4g}"
    if spacing_mm is not None and thickness_mm is not None:
        gap_mm = round(spacing_mm - thickness_mm, 2)
        lengths += f" {'-' if gap_mm < 0 else '+'} {abs(gap_mm):g}"
    verdict = "yes" if one.is_taken else "no"
    return (
        series.label,
        # a header must not send control characters to the terminal
        "".join(c if c.isprintable() else "?" for c in series.first.description)[:MAX_DESCRIPTION]
        if descriptions
        else "",
        series.plane,
        str(series.n_images),
        lengths,
        f"{verdict}: {one.reason}" if one.reason else verdict,
    )
