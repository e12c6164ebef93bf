"""`g3r-bench kernels`: rates of the renderer relative to the limits of the machine, and the rest of a step."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

from g3r.bench.record import add_output_arguments, machine, markdown_table, run_measurement

SIZES = (1000, 4000, 16000, 64000)
REFERENCE_GAUSSIANS, REFERENCE_SLICES = 200, 2
"""The dense reference evaluates every Gaussian at every pixel, so it is timed on this small scene only."""

EXPLANATION = (
    "A pixel counts once for each Gaussian whose ellipse holds it; the set-up of pairs and, backward, the "
    "chain to all parameters are included. FMA/px and copied B/px: how many fused multiply-adds, and how "
    "many bytes of memory read and written, the same core manages in the time of one such pixel. step / "
    "kernels: a whole optimiser step over the two calls; not kernel: its share outside the one kernel that "
    "it calls."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `g3r-bench kernels`."""
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES), help="numbers of Gaussians")
    parser.add_argument("--repeats", type=int, default=7, help="of each call; the least time counts")
    add_output_arguments(parser, "kernels", "")


def run(options: argparse.Namespace) -> int:
    """Measure, and write the results; returns the exit code."""
    return run_measurement(options, "kernels", measure=lambda keep: _measure(options, keep), tables=table)


def _measure(options: argparse.Namespace, keep: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """All measurements, by one thread: CPU seconds, the least of several.

    The copy and fused-multiply-add rates are measured again before each size, so that a machine that others
    use, too, is compared with itself.
    """
    import numba

    from g3r.bench.kernel_timing import (
        copy_bytes_per_second,
        fused_per_second,
        numba_rates,
        reference_rates,
        step_seconds,
    )

    rows: list[dict[str, Any]] = []
    conditions = {"machine": machine(), "date": time.strftime("%Y-%m-%d"), "repeats": options.repeats}
    record = conditions | {"rows": rows}
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        for size in options.sizes:
            limits = {
                "copy_bytes_per_second": copy_bytes_per_second(options.repeats),
                "fused_per_second": fused_per_second(options.repeats),
            }
            rates = numba_rates(size, options.repeats)
            rows.append(_row("numba", size, limits, rates) | step_seconds(size, options.repeats))
            keep(record)
        rates = reference_rates(REFERENCE_GAUSSIANS, REFERENCE_SLICES, options.repeats)
        rows.append(_row("reference", REFERENCE_GAUSSIANS, limits, rates))
    finally:
        numba.set_num_threads(before)
    return record


def _row(backend: str, n_gaussians: int, limits: dict[str, float], rates: dict[str, float]) -> dict[str, Any]:
    """Rates, and the operations that the machine could have done in the same time."""
    row: dict[str, Any] = {"backend": backend, "n_gaussians": n_gaussians, **limits, **rates}
    for name in ("forward", "backward"):
        seconds, n_pixels = rates[f"{name}_seconds"], rates["n_pixels"]
        row[f"{name}_pixels_per_second"] = n_pixels / seconds
        row[f"{name}_pairs_per_second"] = rates["n_pairs"] / seconds
        row[f"{name}_fused_per_pixel"] = limits["fused_per_second"] * seconds / n_pixels
        row[f"{name}_copied_bytes_per_pixel"] = limits["copy_bytes_per_second"] * seconds / n_pixels
    return row


def table(record: dict[str, Any]) -> str:
    """The record as a Markdown table."""
    where = record["machine"]
    head = [
        "backend",
        "Gaussians",
        "pairs",
        "pixels per pair",
        "forward Mpx/s",
        "FMA/px",
        "copied B/px",
        "backward Mpx/s",
        "FMA/px",
        "copied B/px",
        "step / kernels",
        "not kernel",
    ]
    rows = []
    for row in record["rows"]:
        pixels_per_pair = row["n_pixels"] / row["n_pairs"]
        cells = [row["backend"], f"{row['n_gaussians']:,}", f"{row['n_pairs']:,}", f"{pixels_per_pair:.0f}"]
        for name in ("forward", "backward"):
            cells += [
                f"{row[f'{name}_pixels_per_second'] / 1e6:.0f}",
                f"{row[f'{name}_fused_per_pixel']:.0f}",
                f"{row[f'{name}_copied_bytes_per_pixel']:.0f}",
            ]
        if "step_seconds" in row:
            cells += [f"{row['step_over_kernels']:.2f}", f"{100 * row['not_kernel_share']:.0f} %"]
        else:
            cells += ["", ""]
        rows.append(cells)
    where_line = (
        f"{where['processor']}, one core; g3r {where['g3r']}"
        f"{' at ' + where['commit'] if where['commit'] else ''}, numba {where['numba']}; {record['date']}."
    )
    return "\n\n".join([where_line, markdown_table(head, rows), EXPLANATION])
