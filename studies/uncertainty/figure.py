"""Figure of the calibration: error against stated uncertainty, and sparsification curves."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from studies.tables import new_figure, save_figure, stacks
from studies.uncertainty.judgement import REMOVED_SHARES

COLOURS = {1: "#c0392b", 2: "#c58a3a", 3: "#2f6fb0"}


def draw_calibration(record: Mapping[str, Any], path: Path) -> None:
    """A panel per number of stacks with error against stated uncertainty, and one of sparsification.

    Args:
        record: of `check_record`.
        path: PNG to write, atomically.
    """
    numbers = [int(n) for n in record["by_stacks"]]
    figure = new_figure((4.3 * (len(numbers) + 1), 4.3))
    panels = figure.subplots(1, len(numbers) + 1)
    for panel, n in zip(panels, numbers, strict=False):
        _calibration(panel, record, n)
    _sparsification(panels[-1], record)
    save_figure(figure, path)


def _calibration(panel: Any, record: Mapping[str, Any], n: int) -> None:
    """Draw mean and root-mean-square error of ten groups of voxels against their stated uncertainty."""
    colour = COLOURS.get(n, "#4a4a4a")
    of_n = [one for one in record["subjects"].values() if one["n_stacks"] == n and one["registered"]]
    for k, one in enumerate(of_n):
        panel.plot(
            *_points(one, "mean_error"),
            color=colour,
            lw=0.8,
            alpha=0.45,
            label=f"single subjects ({len(of_n)})" if k == 0 else None,
        )
    together = record["by_stacks"][str(n)]
    panel.plot(*_points(together, "mean_error"), "o-", color=colour, lw=2, ms=5, label="mean absolute error")
    panel.plot(*_points(together, "rms_error"), "s", color="none", mec=colour, ms=5, label="root mean square")
    ends = [100 * bin_[key] for one in of_n for bin_ in one["bins"] for key in ("stated", "mean_error")]
    line = np.array([0.7 * min(ends), 1.4 * max(ends)])
    panel.plot(line, line, "--", color="#444444", lw=1, label="error as stated")
    panel.set_xscale("log")
    panel.set_yscale("log")
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_formatter(lambda value, _: f"{value:g}")
        axis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in "235" else "")
        axis.set_tick_params(which="minor", labelsize=8)
    panel.set_title(stacks(n), fontsize=11)
    panel.set_xlabel("stated uncertainty, % of the brightest tissue")
    panel.set_ylabel("error found, %")
    panel.grid(alpha=0.25, which="both", lw=0.5)
    panel.legend(fontsize=8, loc="upper left")


def _sparsification(panel: Any, record: Mapping[str, Any]) -> None:
    """Draw the mean error of the voxels that are kept, relative to the mean error of all voxels."""
    removed = 100 * REMOVED_SHARES
    for n, one in record["by_stacks"].items():
        colour = COLOURS.get(int(n), "#4a4a4a")
        for key, style, what in (("stated", "-", "by uncertainty"), ("ideal", ":", "by the error itself")):
            kept = np.array(one["sparsification"][key]) / one["mean_error"]
            panel.plot(removed, kept, style, color=colour, label=f"{stacks(int(n))}, {what}")
    panel.axhline(1, color="#444444", ls="--", lw=1, label="at random (a constant)")
    panel.set_xlabel("most uncertain voxels removed, %")
    panel.set_ylabel("mean error of the others / of all")
    panel.set_ylim(0, 1.08)
    panel.set_title("does it rank the errors?", fontsize=11)
    panel.grid(alpha=0.25)
    panel.legend(fontsize=8, loc="lower left")


def _points(figures: Mapping[str, Any], what: str) -> tuple[list[float], list[float]]:
    return [100 * b["stated"] for b in figures["bins"]], [100 * b[what] for b in figures["bins"]]
