"""The record of `g3r-bench scaling` as tables and as a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from g3r.bench.record import machine_line, markdown_table
from g3r.bench.scaling import MAX_EXPONENT, MIN_EXPONENT

COLOURS = {"optimiser step": "#0072b2", "overlap search": "#e69f00", "amplitudes": "#009e73", "volume": "#cc79a7"}

MB = 1e6

DECADE = 10.0


@dataclass(frozen=True)
class Exponent:
    """Slope of log(cost) over log(size), with its standard error.

    Attributes:
        value: cost grows as size to this power.
        spread: standard error; zero for two sizes.
        n_sizes: number of sizes in the fit.
    """

    value: float
    spread: float
    n_sizes: int


def fitted_exponent(size: Sequence[float], cost: Sequence[float], largest_decade: bool = False) -> Exponent:
    """The exponent of a straight line through the logarithms, by least squares.

    Args:
        size: sizes, ascending.
        cost: costs, positive.
        largest_decade: whether to use only sizes within a factor of 10 of the largest, to leave out the fixed cost
            of small sizes.

    Raises:
        ValueError: the lists differ in length, there are fewer than two sizes, or values are not positive.
    """
    x, y = np.asarray(size, dtype=np.float64), np.asarray(cost, dtype=np.float64)
    if x.shape != y.shape or x.ndim != 1:
        raise ValueError(f"{x.shape} sizes and {y.shape} costs; expected as many")
    if largest_decade:
        kept = x >= x.max(initial=0.0) / DECADE
        x, y = x[kept], y[kept]
    if len(x) < 2 or x.min() <= 0 or y.min() <= 0 or np.ptp(x) == 0:
        raise ValueError("expected two sizes or more, and positive sizes and costs")
    x, y = np.log(x), np.log(y)
    x = x - x.mean()
    slope = float(x @ y / (x @ x))
    rest = y - y.mean() - slope * x
    spread = float(np.sqrt(rest @ rest / (len(x) - 2) / (x @ x))) if len(x) > 2 else 0.0
    return Exponent(slope, spread, len(x))


def scaling_tables(record: Mapping[str, Any]) -> str:
    """All tables: exponents, then the figures that they were fitted to, with the machine below."""
    parts = [_exponent_table(record)]
    parts += [_growth_table(name, rows) for name, rows in record["growing"].items()]
    parts.append(
        "Exponents are slopes between logarithms, with their standard errors: over the largest decade of "
        "sizes, where the fixed cost of a call no longer counts, and over all. By design a pair and a pixel "
        "evaluation each take a fixed time, which predicts 1. Where pixels or voxels grow, pairs "
        "do not: the exponent under test is that of the seconds less those of the same pairs with a pixel in "
        "each corner of their planes (set-up). Elsewhere it is that of all seconds. "
        f"(!) is outside {MIN_EXPONENT:g} to {MAX_EXPONENT:g}. Seconds are CPU time, the least of "
        f"several calls; memory is what a call holds beyond its arguments. {machine_line(record['machine'])}"
    )
    return "\n\n".join(parts)


def judged_exponent(rows: Sequence[Mapping[str, Any]], operation: str) -> Exponent | None:
    """Exponent of the largest decade, without the set-up of pairs if that was measured; None if nothing remains."""
    cost = [row["seconds"][operation] - row.get("setup_seconds", {}).get(operation, 0.0) for row in rows]
    if min(cost[-2:]) <= 0:
        return None
    size = [row["size"] for row in rows]
    usable = [(n, c) for n, c in zip(size, cost, strict=True) if c > 0]
    return fitted_exponent([n for n, _ in usable], [c for _, c in usable], largest_decade=True)


def exponents(rows: list[dict[str, Any]], operation: str, kind: str) -> tuple[Exponent, Exponent] | None:
    """Exponents of the largest decade and of all sizes; None if nothing was measured.

    Args:
        rows: rows of one growing size.
        operation: see `g3r.bench.scaling`.
        kind: "seconds" or "bytes".
    """
    cost = [row[kind][operation] for row in rows]
    if None in cost:
        return None
    size = [row["size"] for row in rows]
    return fitted_exponent(size, cost, largest_decade=True), fitted_exponent(size, cost)


def _exponent_table(record: Mapping[str, Any]) -> str:
    lines = []
    for name, rows in record["growing"].items():
        work = [fitted_exponent([r["size"] for r in rows], [r[key] for r in rows], True).value for key in WORK]
        for operation in rows[0]["seconds"]:
            time, memory = (exponents(rows, operation, kind) for kind in ("seconds", "bytes"))
            assert time is not None
            judged = judged_exponent(rows, operation)
            outside = judged is None or not MIN_EXPONENT <= judged.value <= MAX_EXPONENT
            cells = [
                f"{operation}, {name}",
                f"{work[0]:.2f}",
                f"{work[1]:.2f}",
                (_written(judged) if judged else "") + (" (!)" if outside else ""),
                _written(time[0]),
                _written(time[1]),
                _written(memory[0]) if memory else "not measured",
            ]
            lines.append(cells)
    head = [
        "exponent of",
        "pairs",
        "pixel evaluations",
        "judged",
        "seconds, largest decade",
        "seconds, all sizes",
        "memory, largest decade",
    ]
    return markdown_table(head, lines)


WORK = ("pairs", "evaluations")


def _written(exponent: Exponent) -> str:
    return f"{exponent.value:.2f} ± {exponent.spread:.2f}"


def _growth_table(name: str, rows: list[dict[str, Any]]) -> str:
    operations = list(rows[0]["seconds"])
    head = [name, "pairs", "pixel evaluations"]
    units = ("ms", "MB", "set-up ms") if "setup_seconds" in rows[0] else ("ms", "MB")
    head += [f"{operation}, {unit}" for operation in operations for unit in units]
    lines = []
    for row in rows:
        cells = [f"{row['size']:,}", f"{row['pairs']:,}", f"{row['evaluations']:,}"]
        for operation in operations:
            held = row["bytes"][operation]
            cells += [f"{1000 * row['seconds'][operation]:.1f}", "" if held is None else f"{held / MB:.1f}"]
            if "setup_seconds" in row:
                cells.append(f"{1000 * row['setup_seconds'][operation]:.1f}")
        lines.append(cells)
    return markdown_table(head, lines)


def draw_scaling(record: Mapping[str, Any], path: Path) -> None:
    """A panel per growing size: CPU seconds of each operation, and a grey line of slope 1; written as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    growing = record["growing"]
    figure = Figure(figsize=(3.4 * len(growing) + 0.4, 3.9), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(growing), squeeze=False, sharey=True)[0]
    legend: dict[str, Any] = {}
    for axis, (name, rows) in zip(axes, growing.items(), strict=True):
        size = [row["size"] for row in rows]
        for operation in rows[0]["seconds"]:
            seconds = [row["seconds"][operation] for row in rows]
            colour = COLOURS[operation]
            (legend[operation],) = axis.plot(size, seconds, "o-", color=colour, ms=4, lw=1.2)
            last = [seconds[-1] * n / size[-1] for n in size]
            (line,) = axis.plot(size, last, "--", color="#b8b8b8", lw=0.8, zorder=0)
            legend["proportional"] = line
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xlabel(name)
        axis.grid(color="#e5e5e5", lw=0.6)
    axes[0].set_ylabel("CPU seconds")
    figure.legend(legend.values(), legend.keys(), loc="outside upper center", ncols=5, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
