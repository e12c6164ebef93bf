"""Building blocks of the tables and figures of the studies."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import TYPE_CHECKING, Any

from g3r.bench.record import markdown_table
from g3r.run.atomic_file import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Cell = str | Callable[[Any], object]
"""Content of a column: a format such as "{scores[V_prior][ssim]:.3f}", or a function of the row."""


def table(rows: Iterable[Mapping[str, Any]], columns: Mapping[str, Cell] | Sequence[tuple[str, Cell]]) -> str:
    """A table in Markdown. A cell is empty if the row lacks a value that its format names.

    Args:
        rows: values by name.
        columns: cells by column heading; pairs if a heading occurs twice.
    """
    listed = list(columns.items()) if isinstance(columns, Mapping) else columns
    return markdown_table([head for head, _ in listed], [[_cell(row, cell) for _, cell in listed] for row in rows])


def _cell(row: Mapping[str, Any], cell: Cell) -> object:
    if callable(cell):
        return cell(row)
    try:
        return cell.format_map(row)
    except KeyError:
        return ""


def details(summary: str, *parts: str) -> str:
    """Markdown that is collapsed below its summary."""
    return "\n\n".join([f"<details><summary>{summary}</summary>", *parts, "</details>"])


def spread(values: Sequence[float], form: str = "{:.2f}") -> str:
    """Mean and standard deviation; a single value gives the mean alone, none gives "-"."""
    if not values:
        return "-"
    deviation = f" ± {form.replace('+', '').format(stdev(values))}" if len(values) > 1 else ""
    return form.format(mean(values)) + deviation


def marked(text: str, good: bool) -> str:
    """The text, with (!) unless `good`."""
    return text if good else f"{text} (!)"


def stacks(n: int) -> str:
    """A number of stacks in words."""
    return f"{n} stack{'s' * (n != 1)}"


def new_figure(size: tuple[float, float], **options: Any) -> Figure:
    """An empty figure that needs no display.

    Args:
        size: width and height in inches.
        options: of matplotlib's Figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained", **options)
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path, dpi: int = 110) -> None:
    """Write a PNG atomically; missing folders are created.

    Args:
        figure: to write.
        path: of the PNG.
        dpi: dots per inch.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
