"""The figure of the lesion test: sections through one lesion of each kind, truth and reconstructions."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from g3r.geometry import VolumeGrid
from studies.lesions.volumes import with_lesions

if TYPE_CHECKING:
    from studies.lesions.runs import LesionRun

HALF_WIDTH_MM = {"bright": 20.0, "dark": 20.0, "ventricle": 38.0}
"""Shown around a lesion's middle."""

KINDS = tuple(HALF_WIDTH_MM)
PANEL_INCHES = 1.75


def draw_lesions_kept(runs: Sequence[LesionRun], variants: Sequence[str], path: Path) -> None:
    """A row for the truth and each variant, a column for each kind of lesion and number of stacks.

    Args:
        runs: of one head.
        variants: rows below the truth.
        path: PNG to write, whole or not at all.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    n_columns = len(runs) * len(KINDS)
    size = ((n_columns + 0.4) * PANEL_INCHES, (len(variants) + 1.35) * PANEL_INCHES)
    figure = Figure(figsize=size, facecolor="black", layout="constrained", dpi=100)
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(len(variants) + 1, n_columns, squeeze=False)
    for block, run in enumerate(runs):
        truth = with_lesions(run.subject.healthy, run.subject.lesions).data
        high = float(np.percentile(truth[run.subject.healthy.mask], 99.7))
        for column, kind in enumerate(KINDS):
            # of several spheres the first: no choice by how well it came out
            number = next(k for k, lesion in enumerate(run.subject.lesions) if lesion.kind == kind)
            lesion = run.subject.lesions[number]
            rows = [("truth", truth, "")]
            rows += [(name, run.volumes[name], f"{run.kept[name][number]:.2f}") for name in variants]
            for row, (name, volume, kept) in enumerate(rows):
                panel = panels[row, block * len(KINDS) + column]
                shown = _section(volume, run.subject.grid, lesion.center_mm, HALF_WIDTH_MM[kind])
                panel.imshow(shown.T, cmap="gray", vmin=0, vmax=high, origin="lower", interpolation="bilinear")
                _quiet(panel)
                panel.text(0.03, 0.03, kept, transform=panel.transAxes, color="#e8b04a", fontsize=10, va="bottom")
                if row == 0:
                    stacks = f"{run.n_stacks} stack{'s' * (run.n_stacks > 1)}"
                    panel.set_title(f"{kind}, {stacks}", color="#c8c8c8", fontsize=10)
                if block == column == 0:
                    panel.set_ylabel(name, color="#c8c8c8", fontsize=11)
    figure.suptitle(
        f"{runs[0].subject.name}: share of the lesion's contrast that is kept", color="#c8c8c8", fontsize=11
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{os.getpid()}.png")
    canvas.print_png(beside)
    os.replace(beside, path)


def _section(
    volume: NDArray[np.float32], grid: VolumeGrid, center_mm: NDArray[np.float64], half_mm: float
) -> NDArray[np.float32]:
    """The axial section [x, y] around a point, padded with zeros where the volume ends."""
    center = np.round(grid.index(center_mm)).astype(int)
    reach = np.ceil(half_mm / grid.spacing_mm).astype(int)
    plane = np.pad(volume[:, :, center[2]], ((reach[0], reach[0]), (reach[1], reach[1])))
    return plane[center[0] : center[0] + 2 * reach[0] + 1, center[1] : center[1] + 2 * reach[1] + 1]


def _quiet(panel: Any) -> None:
    panel.set_xticks([])
    panel.set_yticks([])
    for side in panel.spines.values():
        side.set_visible(False)
