"""Figures of docs/paper.md: PSNR against the number of stacks, and the slices of one subject by every method."""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import mean, stdev

from studies.harness import Record
from studies.paper.ablation import VARIANTS
from studies.paper.methods import EXACT, FILL, OWN, PRINTED, PRIOR, PRODUCT, SCATTER, SQUARES, VARIATION
from studies.paper.pictures import draw_methods
from studies.paper.tables import rows_of, variant_values
from studies.tables import new_figure, save_figure

PHANTOMS = "phantoms"

SHOWN = (PRODUCT, PRIOR, VARIATION, SQUARES, FILL, PRINTED, EXACT, EXACT + OWN, SCATTER)


def suffix(record: Record) -> str:
    """Suffix of the names of tables and pictures, which differs between atlas volumes and phantoms."""
    return "" if record["subjects"] == PHANTOMS else "-atlas"


def draw(record: Record, options: argparse.Namespace) -> None:
    """Draw the pictures of three stacks and of one stack, next to `options.figure`, and the curve."""
    path: Path = options.figure
    for n, name in ((3, f"paper-methods{suffix(record)}.png"), (1, f"paper-one-stack{suffix(record)}.png")):
        rows = [row for row in rows_of(record, "methods", motion="moderate", n_stacks=n) if "stages" in row]
        found = [(row, options.output / "sections" / f"{row['subject']}-{n}.npz") for row in rows]
        there = [(row, file) for row, file in found if file.is_file()]
        if there:
            # the subject of median age: neither the smoothest nor the most folded brain
            row, file = sorted(there, key=lambda pair: pair[0]["weeks"])[len(there) // 2]
            titles = {k: f"{v['mask']['psnr_db']:.1f} dB" for k, v in row["scores"].items()}
            draw_methods(file, SHOWN, path.with_name(name), titles | {"truth": f"{row['weeks']:.0f} weeks"})
    _draw_variants(record, path.with_name(f"paper-stacks{suffix(record)}.png"))


def _draw_variants(record: Record, path: Path) -> None:
    """Draw Fig. 4A: mean PSNR of each variant against the number of stacks."""
    rows = rows_of(record, "variants")
    if not rows:
        return
    figure = new_figure((6, 4))
    axes = figure.subplots()
    for shift, name in enumerate(VARIANTS):
        points = [(n, found) for n in (3, 2, 1) if (found := variant_values(rows, name, n))]
        x = [n + 0.03 * (shift - 2) for n, _ in points]
        spreads = [stdev(found) if len(found) > 1 else 0 for _, found in points]
        axes.errorbar(x, [mean(found) for _, found in points], spreads, marker="o", capsize=2, label=name)
    axes.set_xticks([3, 2, 1])
    axes.invert_xaxis()
    axes.set_xlabel("stacks")
    axes.set_ylabel("PSNR in the mask, dB")
    axes.legend(fontsize=8)
    save_figure(figure, path)
