"""A picture of volumes: central axial, coronal and sagittal sections, one row per volume."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import nibabel as nib
import numpy as np
from numpy.typing import ArrayLike, NDArray

from g3r.errors import cannot_be_written
from g3r.geometry.grid import bounding_box
from g3r.run.atomic_file import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BACKGROUND = "#000000"
INK = "#c8c8c8"
FAINT_INK = "#8a8a8a"
MARK = "#35c4e8"
"""Outlines what no slice saw."""

MARGIN_MM = 6.0
"""Shown around the mask."""

SCALE_BAR_MM = 20.0
ROW_HEIGHT_INCHES = 2.5
DOTS_PER_INCH = 130
TITLE_LINE_INCHES = 0.19
TITLE_LETTER_INCHES = 0.092
"""Height of a line and mean width of a letter at the size of the title."""


@dataclass(frozen=True, kw_only=True)
class View:
    """One plane through the volume: which world axes run right and up, and the letters at its four sides.

    Radiological convention: the patient's right is on the left of axial and coronal sections; sagittal
    sections face left.
    """

    name: str
    normal: int
    across: int
    up: int
    letters: str  # left, right, top, bottom


VIEWS = (
    View(name="axial", normal=2, across=0, up=1, letters="RLAP"),
    View(name="coronal", normal=1, across=0, up=2, letters="RLSI"),
    View(name="sagittal", normal=0, across=1, up=2, letters="APSI"),
)


@dataclass(frozen=True, kw_only=True)
class Row:
    """One volume [I, J, K] to be shown: its name, whether it is a map, a caption, and the ends of its bar."""

    name: str
    data: NDArray[np.float32]
    is_map: bool
    caption: str
    range: tuple[float, float] | None


def save_sections(
    path: str | os.PathLike[str],
    volumes: Mapping[str, ArrayLike],
    affine: ArrayLike,
    mask: ArrayLike | None = None,
    *,
    maps: Collection[str] = ("density",),
    captions: Mapping[str, str] | None = None,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    marked: ArrayLike | None = None,
    title: str = "",
) -> None:
    """Write a PNG of the three central sections of each volume, in the order given.

    Each intensity volume has one grey window for its three sections, from 0 (or its lowest value in the
    mask) to the 99.5th percentile in the mask. The volumes named in `maps` are shown in colour with a
    bar, since their values are read and not only looked at.

    Args:
        path: the file; it appears whole or not at all.
        volumes: name to array [I, J, K], all on one grid.
        affine: [4, 4], world (RAS+, mm) from index. Oblique grids are shown along their own axes, lettered
            by the nearest anatomical direction.
        mask: [I, J, K]; the sections go through the middle of it and are cropped around it.
        maps: names of the volumes that are maps.
        captions: what a row shows, in a few words next to its name.
        ranges: values of the two ends of the bar, for maps that have natural ones.
        marked: [I, J, K], a part of the volume that is outlined in every section.
        title: a line above.

    Raises:
        ValueError: no volume, or shapes that differ.
        InputError: the file cannot be written.
    """
    arrays = {name: np.nan_to_num(np.asarray(data, dtype=np.float32)) for name, data in volumes.items()}
    shapes = {data.shape for data in arrays.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 3:
        raise ValueError(f"expected volumes on one 3D grid; found shapes {sorted(shapes)}")
    inside = np.ones(next(iter(shapes)), bool) if mask is None else np.asarray(mask) > 0
    if inside.shape not in shapes:
        raise ValueError(f"mask has shape {inside.shape}; expected {next(iter(shapes))}")
    if not inside.any():
        inside = np.ones_like(inside)
    affine = np.asarray(affine, dtype=np.float64)
    orientation = nib.orientations.io_orientation(affine)
    inside = nib.orientations.apply_orientation(inside, orientation)
    spacing_mm = np.linalg.norm(affine[:3, :3], axis=0)[np.argsort(orientation[:, 0])]
    box, center = _crop(inside, spacing_mm, has_mask=mask is not None)
    canonical = {n: nib.orientations.apply_orientation(data, orientation)[box] for n, data in arrays.items()}
    rows = [
        Row(
            name=name,
            data=data,
            is_map=name in maps,
            caption=(captions or {}).get(name, ""),
            range=(ranges or {}).get(name),
        )
        for name, data in canonical.items()
    ]
    outlined = np.zeros(inside.shape, bool)
    if marked is not None:
        outlined = nib.orientations.apply_orientation(np.asarray(marked) > 0, orientation)
    figure = _draw(rows, inside[box], outlined[box], center, spacing_mm, title)
    write_figure(figure, Path(path))


def _crop(
    inside: NDArray[np.bool_], spacing_mm: NDArray[np.float64], *, has_mask: bool
) -> tuple[tuple[slice, ...], NDArray[np.intp]]:
    """The box to show and, within it, the voxel the sections go through (the middle of the mask)."""
    box = bounding_box(inside)
    middle = np.array([(axis.start + axis.stop) // 2 for axis in box])
    if has_mask:
        box = bounding_box(inside, np.ceil(MARGIN_MM / spacing_mm).astype(int))
    return box, middle - [axis.start for axis in box]


def _draw(
    volumes: Sequence[Row],
    inside: NDArray[np.bool_],
    outlined: NDArray[np.bool_],
    center: NDArray[np.intp],
    spacing_mm: NDArray[np.float64],
    title: str,
) -> Figure:
    """Lay the panels out at one scale in mm, so that lengths compare across views and rows."""
    from matplotlib.figure import Figure

    size_mm = np.array(inside.shape) * spacing_mm
    widths_mm = [size_mm[view.across] for view in VIEWS]
    height_mm = max(size_mm[view.up] for view in VIEWS)
    inches_per_mm = ROW_HEIGHT_INCHES / height_mm
    captioned = any(one.caption for one in volumes)
    left, right, bottom = 0.58 if captioned else 0.38, 0.55, 0.30
    width = sum(widths_mm) * inches_per_mm + left + right + 0.08
    title_lines = textwrap.wrap(title, max(20, int(width / TITLE_LETTER_INCHES)))
    top = 0.34 + (0.08 + TITLE_LINE_INCHES * len(title_lines) if title_lines else 0.0)
    height = len(volumes) * ROW_HEIGHT_INCHES + 0.04 * (len(volumes) - 1) + top + bottom
    figure = Figure(figsize=(width, height), dpi=DOTS_PER_INCH, facecolor=BACKGROUND)
    panels = figure.subplots(
        len(volumes),
        len(VIEWS),
        squeeze=False,
        gridspec_kw={
            "width_ratios": widths_mm,
            "left": left / width,
            "right": 1 - right / width,
            "top": 1 - top / height,
            "bottom": bottom / height,
            "wspace": 0.02,
            "hspace": 0.04 / ROW_HEIGHT_INCHES,
        },
    )
    for row, one in enumerate(volumes):
        low, high = one.range or _window(one.data, inside, is_map=one.is_map)
        # what a mask has cut away is black, also where a volume goes below zero
        data = one.data if one.is_map else np.where(inside | (one.data != 0), one.data, low)
        for panel, view in zip(panels[row], VIEWS, strict=True):
            shown = _section(data, view, center)
            extent = (0.0, size_mm[view.across], 0.0, size_mm[view.up])
            colors = "inferno" if one.is_map else "gray"
            image = panel.imshow(
                shown, cmap=colors, vmin=low, vmax=high, origin="lower", extent=extent, interpolation="bilinear"
            )
            part = _section(outlined, view, center)
            if part.any() and not part.all():
                panel.contour(part, levels=[0.5], colors=[MARK], linewidths=0.8, origin="lower", extent=extent)
            slack = (height_mm - size_mm[view.up]) / 2
            panel.set_ylim(-slack, size_mm[view.up] + slack)
            panel.set_axis_off()
            if row == 0:
                panel.set_title(view.name, color=INK, fontsize=10, pad=6)
                _letter(panel, view.letters)
        box = panels[row][0].get_position()
        middle = (box.y0 + box.y1) / 2
        _side_text(figure, 0.16 / width, middle, one.name, color=INK, fontsize=11)
        _side_text(figure, 0.38 / width, middle, one.caption, color=FAINT_INK, fontsize=7.5)
        if one.is_map:
            last = panels[row][-1].get_position()
            bar = figure.add_axes(
                (last.x1 + 0.06 / width, last.y0 + 0.15 * last.height, 0.08 / width, 0.7 * last.height)
            )
            figure.colorbar(image, cax=bar)
            bar.tick_params(colors=FAINT_INK, labelsize=7, length=2, pad=2)
            bar.spines[:].set_visible(False)
    _scale_bar(panels[-1][0])
    if title_lines:
        figure.text(0.5, 1 - 0.06 / height, "\n".join(title_lines), color=INK, fontsize=11, ha="center", va="top")
    voxel = " x ".join(f"{value:.2f}" for value in spacing_mm)
    note = f"voxels {voxel} mm; radiological: the patient's right is on the left"
    figure.text(1 - 0.1 / width, 0.13 / height, note, color=FAINT_INK, fontsize=7.5, ha="right", va="center")
    return figure


def _side_text(figure: Figure, x: float, y: float, text: str, *, color: str, fontsize: float) -> None:
    """Write a line upwards, left of a row."""
    figure.text(x, y, text, rotation=90, color=color, fontsize=fontsize, ha="center", va="center")


def _section(data: NDArray[Any], view: View, center: NDArray[np.intp]) -> NDArray[Any]:
    """The plane [up, across] of a RAS volume, the across axis reversed: R (or A) comes to the left."""
    plane = np.take(data, int(center[view.normal]), axis=view.normal)
    return plane[::-1, :].T


def _window(data: NDArray[np.float32], inside: NDArray[np.bool_], *, is_map: bool) -> tuple[float, float]:
    """Values shown as black and white."""
    values = data[inside]
    low = min(0.0, float(np.percentile(values, 0.5)))
    high = float(values.max() if is_map and values.size < 100 else np.percentile(values, 99.5))
    return low, high if high > low else low + 1.0


def _letter(panel: Axes, letters: str) -> None:
    """Write the anatomical directions at the four sides, outlined: there may be image below them."""
    from matplotlib.patheffects import withStroke

    outline = [withStroke(linewidth=2, foreground=BACKGROUND)]
    places = ((0.02, 0.5), (0.98, 0.5), (0.5, 0.99), (0.5, 0.01))
    aligned = (("left", "center"), ("right", "center"), ("center", "top"), ("center", "bottom"))
    for letter, (x, y), (horizontal, vertical) in zip(letters, places, aligned, strict=True):
        text = panel.text(x, y, letter, transform=panel.transAxes, ha=horizontal, va=vertical)
        text.set(color="#e8b04a", fontsize=8, path_effects=outline)


def _scale_bar(panel: Axes) -> None:
    """Draw a bar of known length in the lower left corner."""
    x, y = panel.get_xlim()[0] + 3.0, panel.get_ylim()[0] + 3.0
    panel.plot([x, x + SCALE_BAR_MM], [y, y], color=INK, linewidth=2, solid_capstyle="butt")
    panel.text(x, y + 1.5, f"{SCALE_BAR_MM / 10:.0f} cm", color=INK, fontsize=7.5, ha="left", va="bottom")


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, whole or not at all; raises `InputError` where it cannot be written."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    try:
        with atomic_path(path) as temporary:
            FigureCanvasAgg(figure).print_png(temporary)
    except OSError as error:
        raise cannot_be_written(path, error) from None
