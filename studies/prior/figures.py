"""Figures of the prior studies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from studies.tables import new_figure, save_figure, stacks

COLOURS = ("#9a9a9a", "#c58a3a", "#2f9e6e", "#4a4a4a", "#5b8fd6", "#c0392b", "#8e5bb5", "#17a2b8")
SIDEWAYS = 0.05
"""Horizontal offset between the points of different lines, in numbers of stacks."""


def draw_ablation(rows: Sequence[Mapping[str, Any]], variants: Sequence[str], baseline: str, path: Path) -> None:
    """PSNR and SSIM by the number of stacks, a line per variant with its spread, and the paired difference.

    Args:
        rows: `n_stacks` and `scores` -> variant -> `psnr_db`, `ssim`.
        variants: lines, in the order of the legend.
        baseline: variant from which the paired differences are taken.
        path: PNG to write, atomically.
    """
    numbers = sorted({row["n_stacks"] for row in rows})
    figure = new_figure((13, 4.2))
    panels = figure.subplots(1, 3)
    for place, variant in enumerate(variants):
        of_number = [[row["scores"] for row in rows if row["n_stacks"] == n] for n in numbers]
        shift = SIDEWAYS * (place - (len(variants) - 1) / 2)
        psnr = [[one[variant]["psnr_db"] for one in found] for found in of_number]
        ssim = [[one[variant]["ssim"] for one in found] for found in of_number]
        gain = [[one[variant]["psnr_db"] - one[baseline]["psnr_db"] for one in found] for found in of_number]
        for panel, values in zip(panels, (psnr, ssim, gain), strict=True):
            if panel is panels[2] and variant == baseline:
                continue
            panel.errorbar(
                np.array(numbers) + shift,
                [np.mean(v) for v in values],
                [_deviation(v) for v in values],
                color=COLOURS[place % len(COLOURS)],
                marker="o",
                markersize=4,
                capsize=2.5,
                linewidth=1.4,
                label=variant,
            )
            if panel is panels[2]:
                for n, found in zip(numbers, values, strict=True):
                    panel.plot(
                        [n + shift] * len(found),
                        found,
                        ".",
                        markersize=3,
                        alpha=0.5,
                        color=COLOURS[place % len(COLOURS)],
                    )
    titles = ("PSNR (dB)", "SSIM", f"difference to the {baseline} (dB)")
    for panel, title in zip(panels, titles, strict=True):
        panel.set_title(title, fontsize=10)
        panel.set_xlabel("stacks")
        panel.set_xticks(numbers)
        panel.grid(alpha=0.25)
    panels[2].axhline(0, color=COLOURS[3], linewidth=1)
    panels[0].legend(fontsize=8, loc="best")
    save_figure(figure, path)


def draw_networks(record: Mapping[str, Any], path: Path) -> None:
    """Draw the gain of each variant over V_coarse by the number of stacks, and error against seconds for the sizes.

    Args:
        record: of `studies.prior.networks`.
        path: PNG to write, atomically.
    """
    scores = {name: row["scores"] for name, row in record["rows"].items()}
    coarse = scores.pop("V_coarse")
    numbers = [n for n in coarse if n != "all"]
    figure = new_figure((12, 4.4))
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    rows = np.arange(len(scores))
    thick = 0.8 / len(numbers)
    for place, n in enumerate(numbers):
        gain = [of[n]["psnr_db"] - coarse[n]["psnr_db"] if n in of else 0.0 for of in scores.values()]
        left.barh(rows + thick * place - 0.4, gain, thick, align="edge", color=COLOURS[4 - place], label=stacks(int(n)))
    left.set_yticks(rows, list(scores), fontsize=9)
    left.invert_yaxis()
    left.set_title("PSNR gained over V_coarse (dB)", fontsize=10)
    left.legend(fontsize=8)
    left.grid(alpha=0.25, axis="x")
    sizes = sorted(
        (one["seconds"], one["scores"]["all"]["l1"], n) for n, one in record["rows"].items() if one.get("is_size")
    )
    right.plot([s for s, _, _ in sizes], [error for _, error, _ in sizes], "o-", color=COLOURS[5])
    for seconds, error, name in sizes:
        right.annotate(name, (seconds, error), textcoords="offset points", xytext=(6, 6), fontsize=8)
    right.margins(0.2)
    right.set_title("size: validation error against seconds per brain", fontsize=10)
    right.set_xlabel(f"seconds for a 36-week brain, {record['threads']} threads")
    right.set_ylabel("mean absolute error in the mask")
    right.grid(alpha=0.25)
    save_figure(figure, path)


def _deviation(values: Sequence[float]) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
