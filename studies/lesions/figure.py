"""The figure of the lesion study: sections through one lesion of each kind, truth and reconstructions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from g3r.geometry import VolumeGrid
from studies.lesions.volumes import with_lesions
from studies.tables import new_figure, save_figure, stacks

if TYPE_CHECKING:
    from studies.lesions.runs import LesionRun

HALF_WIDTH_MM = {"bright": 20.0, "dark": 20.0, "ventricle": 38.0}
"""Half the width of the section around a lesion's centre."""

PANEL_INCHES = 1.75
GREY = "#c8c8c8"
TRUTH = "truth"


def save_sections(run: LesionRun, path: Path) -> None:
    """Save the data of the figure of a run: sections and shares by kind and volume, and the white point."""
    subject = run.subject
    truth = with_lesions(subject.healthy, subject.lesions).data
    kept: dict[str, Any] = {"white": np.percentile(truth[subject.healthy.mask], 99.7)}
    for kind, half_mm in HALF_WIDTH_MM.items():
        # always the first of several spheres, not the best one
        number = next(k for k, lesion in enumerate(subject.lesions) if lesion.kind == kind)
        for name, volume in {TRUTH: truth, **run.volumes}.items():
            center_mm = subject.lesions[number].center_mm
            kept[f"{kind}/{name}"] = _section(volume, subject.grid, center_mm, half_mm)
            kept[f"{kind}/{name}/kept"] = run.kept[name][number] if name in run.kept else np.nan
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **kept)


def draw_lesions_kept(subject: str, sections: Mapping[int, Path], variants: Sequence[str], path: Path) -> None:
    """A row for the truth and each variant, a column for each kind of lesion and number of stacks.

    Args:
        subject: name of the head.
        sections: files of `save_sections`, by number of stacks.
        variants: rows below the truth.
        path: PNG to write, atomically.
    """
    names = (TRUTH, *variants)
    n_columns = len(sections) * len(HALF_WIDTH_MM)
    size = ((n_columns + 0.4) * PANEL_INCHES, (len(names) + 0.35) * PANEL_INCHES)
    figure = new_figure(size, facecolor="black")
    panels = figure.subplots(len(names), n_columns, squeeze=False)
    columns = [(n, _arrays(file), kind) for n, file in sections.items() for kind in HALF_WIDTH_MM]
    for column, (n, shown, kind) in enumerate(columns):
        for row, name in enumerate(names):
            panel = panels[row, column]
            section, kept = shown[f"{kind}/{name}"], float(shown[f"{kind}/{name}/kept"])
            panel.imshow(
                section.T, cmap="gray", vmin=0, vmax=float(shown["white"]), origin="lower", interpolation="bilinear"
            )
            panel.set(xticks=[], yticks=[])
            panel.spines[:].set_visible(False)
            if name != TRUTH:
                text = f"{kept:.2f}"
                panel.text(0.03, 0.03, text, transform=panel.transAxes, color="#e8b04a", fontsize=10, va="bottom")
            if row == 0:
                panel.set_title(f"{kind}, {stacks(n)}", color=GREY, fontsize=10)
            if column == 0:
                panel.set_ylabel(name, color=GREY, fontsize=11)
    figure.suptitle(f"{subject}: share of the lesion's contrast that is kept", color=GREY, fontsize=11)
    save_figure(figure, path, dpi=100)


def _section(
    volume: NDArray[np.float32], grid: VolumeGrid, center_mm: NDArray[np.float64], half_mm: float
) -> NDArray[np.float32]:
    """The axial section [x, y] around a point, padded with zeros beyond the volume."""
    center = np.round(grid.index(center_mm)).astype(int)
    reach = np.ceil(half_mm / grid.spacing_mm).astype(int)
    plane = np.pad(volume[:, :, center[2]], ((reach[0], reach[0]), (reach[1], reach[1])))
    return plane[center[0] : center[0] + 2 * reach[0] + 1, center[1] : center[1] + 2 * reach[1] + 1]


def _arrays(file: Path) -> dict[str, np.ndarray]:
    with np.load(file) as data:
        return dict(data)
