"""The figure of `g3r-bench trade`: PSNR against seconds, one panel per case."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from g3r.bench.trade_tables import Point, pareto_front, points_of, sweep_offset

COLOURS = {"preview": "#cc79a7", "fast": "#e69f00", "balanced": "#0072b2", "accurate": "#009e73"}
SWEEP_COLOURS = {"Gaussians": "#7f3c8d", "iterations": "#d55e00", "cut-off": "#56b4e9", "resolution": "#8c6d31"}

MIN_SHOWN_DB = 6.0
"""The axis begins half of this below the worst preset; curves may begin lower."""


def draw_trade(record: Mapping[str, Any], path: Path) -> None:
    """Draw one panel per case, and write the figure as PNG.

    Presets are markers, sweeps are thin lines with dots, and the quality during each preset's fit is a dashed line (at
    the time at which the command would have ended if the fit had been stopped there). The Pareto front is a grey band.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullLocator

    cases = record["cases"]
    figure = Figure(figsize=(6.2 * len(cases) + 0.4, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(cases), squeeze=False)[0]
    legend: dict[str, Any] = {}
    for axis, (name, case) in zip(axes, cases.items(), strict=True):
        points = points_of(case, record["base"])
        _draw_front(axis, points, legend)
        _draw_sweeps(axis, case, record["base"], legend)
        for preset, fit in case.get("fits", {}).items():
            total = case["presets"][preset]["seconds"]
            at = [total - seconds for seconds in fit["curve"]["seconds_before_end"]]
            (line,) = axis.plot(at, fit["curve"]["psnr_db"], "--", color=COLOURS[preset], lw=1.2)
            legend.setdefault("during the fit", line)
        for preset, row in case["presets"].items():
            legend[preset] = axis.scatter(
                row["seconds"], row["psnr_db"], s=70, color=COLOURS[preset], edgecolors="black", zorder=4
            )
        lowest = min(row["psnr_db"] for row in case["presets"].values())
        highest = max(point.psnr_db for point in points)
        axis.set_ylim(min(lowest, highest - 1) - MIN_SHOWN_DB / 2, highest + 0.5)
        axis.set_xscale("log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
        axis.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axis.xaxis.set_minor_locator(NullLocator())
        axis.set_title(name, fontsize=11)
        axis.set_xlabel("seconds of the whole command")
        axis.grid(color="#e5e5e5", lw=0.6, which="both")
        axis.set_axisbelow(True)
    axes[0].set_ylabel("PSNR, dB")
    figure.legend(legend.values(), legend.keys(), loc="outside upper center", ncols=5, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _draw_front(axis: Any, points: list[Point], legend: dict[str, Any]) -> None:
    front = [points[n] for n in pareto_front([p.seconds for p in points], [p.psnr_db for p in points])]
    (line,) = axis.plot(
        [p.seconds for p in front],
        [p.psnr_db for p in front],
        color="#c8c8c8",
        lw=7,
        zorder=1,
        solid_capstyle="round",
        solid_joinstyle="round",
    )
    legend["Pareto front"] = line


def _draw_sweeps(axis: Any, case: Mapping[str, Any], base: str, legend: dict[str, Any]) -> None:
    for sweep, variants in case.get("sweeps", {}).items():
        offset = sweep_offset(case, base)
        rows = list(variants.values())
        (line,) = axis.plot(
            [row["seconds"] + offset for row in rows],
            [row["psnr_db"] for row in rows],
            ".-",
            color=SWEEP_COLOURS.get(sweep, "#666666"),
            lw=0.9,
            ms=5,
            zorder=3,
        )
        legend[sweep] = line
