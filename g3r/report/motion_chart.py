"""Chart of the motion over the slices in order of acquisition, as lines for an SVG drawing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 860.0, 150.0
LEFT, TOP = 44.0, 8.0
"""Margins of the plot in the drawing, in the same units as its width and height."""


@dataclass(frozen=True)
class Line:
    """One axis of the motion in one stack: its name, and its points in SVG's notation."""

    name: str
    points: str


@dataclass(frozen=True, kw_only=True)
class Chart:
    """A drawing of one kind of motion.

    Attributes:
        title: title with the unit.
        lines: one per stack and axis.
        ticks: position and text of the horizontal grid lines.
        stacks: left end, width and name of each stack's part.
        faint: positions [x, y] of down-weighted slices.
    """

    title: str
    lines: tuple[Line, ...]
    ticks: tuple[tuple[float, str], ...]
    stacks: tuple[tuple[float, float, str], ...]
    faint: tuple[tuple[float, float], ...]
    width: float = WIDTH
    height: float = HEIGHT


def motion_chart(
    title: str,
    axes: tuple[str, str, str],
    values: NDArray[np.float64],
    *,
    stack: NDArray[np.int64],
    counts_less: NDArray[np.bool_],
    names: list[str],
) -> Chart:
    """Lay out three lines for each stack.

    Args:
        title: title with the unit.
        axes: names of the three columns.
        values: [K, 3] in the order of acquisition, stack after stack.
        stack: [K] number of the stack.
        counts_less: [K] down-weighted slices; they are marked, and do not set the range.
        names: names of all stacks.
    """
    counted = values[~counts_less] if (~counts_less).any() else values
    limit = _nice(float(np.abs(counted).max(initial=0)))
    plot_width, plot_height = WIDTH - LEFT - 4, HEIGHT - TOP - 20
    n = max(len(values), 1)

    def x(k: float) -> float:
        return round(LEFT + (k + 0.5) / n * plot_width, 1)

    def y(value: float) -> float:
        share = min(max(value / limit, -1.0), 1.0)
        return round(TOP + (1 - share) / 2 * plot_height, 1)

    begins = [0, *(np.flatnonzero(np.diff(stack)) + 1).tolist(), len(stack)]
    lines, parts = [], []
    for begin, end in pairwise(begins):
        if begin == end:
            continue
        edge = round(LEFT + begin / n * plot_width, 1)
        parts.append((edge, round((end - begin) / n * plot_width, 1), names[int(stack[begin])]))
        for axis, name in enumerate(axes):
            points = " ".join(f"{x(k)},{y(float(values[k, axis]))}" for k in range(begin, end))
            lines.append(Line(name, points))
    faint = tuple((x(k), y(float(values[k, axis]))) for k in np.flatnonzero(counts_less).tolist() for axis in range(3))
    ticks = tuple((y(value), f"{value:+g}" if value else "0") for value in (limit, limit / 2, 0.0, -limit / 2, -limit))
    return Chart(title=title, lines=tuple(lines), ticks=ticks, stacks=tuple(parts), faint=faint)


def _nice(value: float) -> float:
    """The next larger of 1, 2, 5, 10, 20, ..., at least 1."""
    if value <= 1:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if value <= step * power)
