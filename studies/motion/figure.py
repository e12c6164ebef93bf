"""Figure of the pose error of every slice, before registration and after each of its layers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.interleave import acquisition_order, place_in_time
from g3r.evaluation.pose_error import PoseTable, SliceKey
from studies.tables import new_figure, save_figure

INTERLEAVE = 2
"""Interleave of all cases: every other slice first."""

JERK_MM = 2.5
JERK_RATIO = 3.0
"""A step between neighbours in time is a jerk if it is longer than JERK_MM and than JERK_RATIO times the median step.
The random walks of all levels stay below; jerks of 6 degrees (4 mm at the rim of a head) do not."""

MIN_SHOWN_MM = 0.01
"""Smaller errors are drawn at this value, because the axis is logarithmic."""

GAP_SLICES = 4
"""Gap between two stacks on the x-axis, in slices."""

COLOURS = {
    "headers": "#b8b8b8",
    "template": "#009e73",
    "network": "#e69f00",
    "stacks": "#56b4e9",
    "best start": "#f0e442",
    "segments": "#cc79a7",
    "slices": "#0072b2",
    "joint": "#d55e00",
}
SHOWN = ("headers", "best start", "segments", "slices", "joint")
"""Layers that the figure shows; the dots of more layers would hide each other."""

OTHER_COLOURS = ("#000000", "#7f3c8d", "#3969ac")


def jerk_slices(true: PoseTable, points_mm: Mapping[SliceKey, NDArray[np.float64]]) -> list[list[int]]:
    """Stack and acquisition rank of each first slice after a jerk, by the true poses.

    Args:
        true: the true poses.
        points_mm: [P, 3] points of each slice.
    """
    jerks = []
    for stack in sorted({n for n, _ in true.keys}):
        rows = {k: row for row, (n, k) in enumerate(true.keys) if n == stack}
        head = np.concatenate([p for (n, _), p in points_mm.items() if n == stack])
        head = head[:: max(1, len(head) // 200)]
        in_time = true.pose.take([rows[k] for k in acquisition_order(len(rows), INTERLEAVE).tolist()])
        there = in_time.apply(np.broadcast_to(head, (len(rows), *head.shape)))
        step_mm = np.linalg.norm(np.diff(there, axis=0), axis=2).mean(1)
        bound = max(JERK_MM, JERK_RATIO * float(np.median(step_mm)))
        jerks += [[stack, int(moment) + 1] for moment in np.flatnonzero(step_mm > bound)]
    return jerks


def draw_slice_errors(cases: Mapping[str, Any], path: Path) -> None:
    """Draw the slice errors measured by `studies.motion.layers`, a panel per case, and write them as PNG.

    Args:
        cases: rows of its record.
        path: PNG to write.
    """
    n_rows = (len(cases) + 1) // 2
    figure = new_figure((12, 2.9 * n_rows + 0.7))
    axes = figure.subplots(n_rows, min(2, len(cases)), squeeze=False, sharey=True)
    legend: dict[str, Any] = {}
    for axis, (name, case) in zip(axes.flat, cases.items(), strict=False):
        width = case["n_slices"]
        start = _stack_starts(width)
        for stack, moment in case["jerks"]:
            axis.axvline(start[stack] + moment - 0.5, color="#666666", lw=0.9, ls=":", zorder=0)
        for n, (first, n_slices) in enumerate(zip(start, width, strict=True)):
            if n % 2 == 0:
                half_gap = GAP_SLICES / 2
                axis.axvspan(first - half_gap, first + n_slices - 1 + half_gap, color="#f4f4f4", zorder=-1, lw=0)
        for number, (layer, figures) in enumerate(case["layers"].items()):
            if layer in COLOURS and layer not in SHOWN:
                continue
            x, y = _dots(figures["per_slice_mm"], start, width)
            colour = COLOURS.get(layer, OTHER_COLOURS[number % len(OTHER_COLOURS)])
            legend[layer] = axis.scatter(
                x, np.maximum(y, MIN_SHOWN_MM), s=9, color=colour, linewidths=0, label=layer, zorder=2
            )
        axis.axhline(1.0, color="black", lw=0.9, zorder=1)
        axis.set_yscale("log")
        axis.set_axisbelow(True)
        middles = [a + n / 2 for a, n in zip(start, width, strict=True)]
        axis.set_xticks(middles, [f"stack {n}" for n in range(len(width))], fontsize=10)
        axis.tick_params(axis="x", length=0)
        axis.set_xlim(-GAP_SLICES / 2, start[-1] + width[-1] - 1 + GAP_SLICES / 2)
        axis.set_title(name, fontsize=11)
        axis.grid(axis="y", color="#e5e5e5", lw=0.6)
    for axis in axes.flat[len(cases) :]:
        axis.axis("off")
    for axis in axes[:, 0]:
        axis.set_ylabel("error of slice, mm")
    axes[0, 0].yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    figure.supxlabel("slices in the order they were taken; dotted: sudden movements; line: 1 mm", fontsize=10)
    figure.legend(
        legend.values(), legend.keys(), loc="outside upper center", ncols=len(legend), frameon=False, markerscale=2
    )
    save_figure(figure, path)


def _stack_starts(n_slices: Sequence[int]) -> list[int]:
    """Start of each stack on the x-axis."""
    return [0, *(np.cumsum(n_slices[:-1]) + GAP_SLICES * np.arange(1, len(n_slices))).tolist()]


def _dots(
    per_slice_mm: Sequence[Sequence[float]], start: Sequence[int], n_slices: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    place = [place_in_time(n, INTERLEAVE) for n in n_slices]
    x = [start[int(n)] + place[int(n)][int(k)] for n, k, _ in per_slice_mm]
    return np.array(x, dtype=np.float64), np.array([error for *_, error in per_slice_mm])
