"""`python -m tests.numerics.tables`: errors at extreme values, as the tables of docs/numerics.md."""

from __future__ import annotations

import argparse
import logging
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from g3r.bench.record import machine, markdown_table, put_between_markers, write_json
from g3r.errors import G3RError
from tests.numerics.errors import (
    THICKNESSES_MM,
    distance_rows,
    gradient_rows,
    gradient_tolerance,
    pixel_rows,
    shape_rows,
    shape_tolerance,
    size_rows,
)
from tests.numerics.fits import step_size_rows, volume_changes

Rows = Sequence[Mapping[str, Any]]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.numerics.tables",
        description="Errors at the extremes, swept and tabulated.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--docs", type=Path, metavar="FILE", help="also put the tables between its markers")
    parser.add_argument("--output", type=Path, default=Path("runs") / "studies" / "numerics")
    parser.add_argument("--only", choices=TABLES, nargs="+", help="some of the tables (None: all)")
    options = parser.parse_args(argv)
    logging.getLogger("g3r.fitting.divergence_guard").setLevel(logging.ERROR)  # the table shows the rollbacks
    record: dict[str, Any] = {"machine": machine(), "tables": {}}
    try:
        for name in options.only or TABLES:
            make, table = TABLES[name]
            record["tables"][name] = rows = make()
            text = table(rows)
            print(f"{name}\n\n{text}\n", flush=True)
            if options.docs:
                put_between_markers(options.docs, f"numerics-{name}", text)
        write_json(options.output / "numerics.json", record)
    except G3RError as error:
        print(f"numerics: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def shown(value: float) -> str:
    """A number with two digits, or in words if it is not finite."""
    return f"{value:.1e}" if math.isfinite(value) else "not finite"


def shape_table(rows: Rows) -> str:
    """Errors of values by axis ratio."""
    names = ("float64", "reference float32", "numba", "naive float32", "naive float32, epsilon", "naive float64")
    return _by_ratio(rows, names, "bound for float32", shape_tolerance)


def gradient_table(rows: Rows) -> str:
    """Errors of gradients by axis ratio."""
    return _by_ratio(rows, ("centre", "shape", "amplitude", "turn", "shift", "gain"), "bound", gradient_tolerance)


def _by_ratio(rows: Rows, names: Sequence[str], bound: str, tolerance: Callable[[float], float]) -> str:
    cells = [
        [
            "slices" if row["psf"] else "V(x)",
            f"{row['ratio']:g}",
            *(shown(row[name]) for name in names),
            shown(tolerance(row["ratio"])),
        ]
        for row in rows
    ]
    return markdown_table(["", "axis ratio", *names, bound], cells)


def size_table(rows: Rows) -> str:
    """Errors of values by size and thickness."""
    thick = [f"{t:g}" for t in (0.0, *THICKNESSES_MM)]
    head = ["sigma, mm", "V(x)", *(f"slices of {t} mm" for t in thick[1:]), "V(x) with 1e-8 mm^6"]
    return markdown_table(
        head, [[f"{row['sigma_mm']:g}", *(shown(row[t]) for t in (*thick, "epsilon"))] for row in rows]
    )


def pixel_table(rows: Rows) -> str:
    """Mass of a Gaussian in samples, by sigma in pixels."""

    def pair(row: Mapping[str, Any], name: str, low: str, high: str) -> str:
        return f"{row[f'{name} {low}']:.3g} to {row[f'{name} {high}']:.3g}"

    return markdown_table(
        ["sigma over pixel", "volume", "by the formula", "slices", "by the formula"],
        [
            [
                f"{row['ratio']:g}",
                *(
                    pair(row, name, low, high)
                    for name in ("volume", "slices")
                    for low, high in (("least", "most"), ("lower bound", "upper bound"))
                ),
            ]
            for row in rows
        ],
    )


def distance_table(rows: Rows) -> str:
    """Errors of values by distance from the world's origin."""
    names = ("reference float64", "reference float32", "numba", "naive float32")
    return markdown_table(
        ["distance, m", *names], [[f"{row['distance_m']:g}", *(shown(row[name]) for name in names)] for row in rows]
    )


def change_table(rows: Rows) -> str:
    """Effect on whole reconstructions of changes that should have none."""
    return markdown_table(
        ["change of the input", "mean change", "largest change", "mean error against the truth"],
        [[row["change"], *(shown(row[name]) for name in ("mean", "largest")), f"{row['error']:.4f}"] for row in rows],
    )


def step_table(rows: Rows) -> str:
    """Fits with too large step sizes."""

    def number(value: float) -> str:
        return f"{value:.4f}" if math.isfinite(value) else "no result"

    return markdown_table(
        ["step sizes", "safeguard", "steps back", "loss at the start", "largest loss", "residual at the end"],
        [
            [
                f"x {row['factor']:g}",
                "on" if row["guarded"] else "off",
                row["back"],
                *(number(row[name]) for name in ("first", "most", "residual")),
            ]
            for row in rows
        ],
    )


TABLES: dict[str, tuple[Any, Any]] = {
    "shape": (shape_rows, shape_table),
    "gradient": (gradient_rows, gradient_table),
    "size": (size_rows, size_table),
    "pixel": (pixel_rows, pixel_table),
    "distance": (distance_rows, distance_table),
    "steps": (step_size_rows, step_table),
    "changes": (volume_changes, change_table),
}
"""Rows and their table, by the name of the markers in docs/numerics.md."""


if __name__ == "__main__":
    raise SystemExit(main())
