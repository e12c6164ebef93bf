"""A picture of volumes: central axial, coronal and sagittal sections, one row per volume."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFilter, ImageFont

from g3r.errors import cannot_be_written
from g3r.geometry.grid import bounding_box
from g3r.output.map_colours import INFERNO
from g3r.run.atomic_file import atomic_path

BACKGROUND = "#000000"
INK = "#c8c8c8"
FAINT_INK = "#8a8a8a"
MARK = "#35c4e8"
"""Colour of the outline around unseen parts."""

MARGIN_MM = 6.0
"""Margin shown around the mask."""

SCALE_BAR_MM = 20.0
ROW_PIXELS = 325
BETWEEN = 5
"""Pixels between panels, and between rows."""

LEFT, LEFT_CAPTIONED, RIGHT, HEAD, FOOT = 50, 75, 82, 44, 39
TITLE_LINE, TITLE_LETTER = 25, 11
"""Height of a line and mean width of a letter of the title, in pixels."""


@dataclass(frozen=True, kw_only=True)
class View:
    """One plane through the volume: the world axes that run right and up, and the letters at its four sides.

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
    bar, because their values are meant to be read.

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
    picture = _draw(rows, inside[box], outlined[box], center, spacing_mm, title)
    try:
        with atomic_path(Path(path)) as temporary:
            picture.save(temporary, format="png")
    except OSError as error:
        raise cannot_be_written(Path(path), error) from None


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
) -> Image.Image:
    """Lay the panels out at one scale in mm, so that lengths compare across views and rows."""
    size_mm = np.array(inside.shape) * spacing_mm
    height_mm = max(size_mm[view.up] for view in VIEWS)
    per_mm = ROW_PIXELS / height_mm
    widths = [max(1, round(size_mm[view.across] * per_mm)) for view in VIEWS]
    left = LEFT_CAPTIONED if any(one.caption for one in volumes) else LEFT
    width = sum(widths) + BETWEEN * (len(VIEWS) - 1) + left + RIGHT
    lines = textwrap.wrap(title, max(20, width // TITLE_LETTER))
    top = HEAD + (TITLE_LINE * len(lines) + 10 if lines else 0)
    picture = Image.new("RGB", (width, top + len(volumes) * (ROW_PIXELS + BETWEEN) + FOOT), BACKGROUND)
    pen = ImageDraw.Draw(picture)
    for number, line in enumerate(lines):
        pen.text((width / 2, 8 + TITLE_LINE * number), line, INK, font=_font(19), anchor="ma")
    for row, one in enumerate(volumes):
        y = top + row * (ROW_PIXELS + BETWEEN)
        low, high = one.range or _window(one.data, inside, is_map=one.is_map)
        # voxels outside the mask are black, also in a volume with negative values
        data = one.data if one.is_map else np.where(inside | (one.data != 0), one.data, low)
        x = left
        for view, wide in zip(VIEWS, widths, strict=True):
            size = (wide, max(1, round(size_mm[view.up] * per_mm)))
            panel = _panel(_section(data, view, center), size, low, high, is_map=one.is_map)
            part = _section(outlined, view, center)
            if part.any() and not part.all():
                panel.paste(MARK, mask=_outline(part, size))
            picture.paste(panel, (x, y + (ROW_PIXELS - size[1]) // 2))
            if row == 0:
                pen.text((x + wide / 2, y - 12), view.name, INK, font=_font(18), anchor="ms")
                _letter(pen, view.letters, (x, y, wide, ROW_PIXELS))
            x += wide + BETWEEN
        middle = y + ROW_PIXELS // 2
        _side_text(picture, (20, middle), one.name, INK, 20)
        _side_text(picture, (49, middle), one.caption, FAINT_INK, 14)
        if one.is_map:
            _bar(picture, (x - BETWEEN + 8, y + int(0.15 * ROW_PIXELS)), int(0.7 * ROW_PIXELS), low, high)
    _scale_bar(pen, left, top + len(volumes) * (ROW_PIXELS + BETWEEN) - BETWEEN, per_mm)
    voxel = " x ".join(f"{value:.2f}" for value in spacing_mm)
    note = f"voxels {voxel} mm; radiological: the patient's right is on the left"
    pen.text((width - 12, picture.height - FOOT / 2), note, FAINT_INK, font=_font(14), anchor="rm")
    return picture


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _panel(
    section: NDArray[np.float32], size: tuple[int, int], low: float, high: float, *, is_map: bool
) -> Image.Image:
    """A section [up, across] in grey or in the colours of maps; its first row is at the bottom."""
    share = (section.astype(np.float64) - low) / (high - low)
    level = Image.fromarray((share[::-1].clip(0, 1) * 255).astype(np.uint8)).resize(size, Image.Resampling.BILINEAR)
    return Image.fromarray(INFERNO[np.asarray(level)]) if is_map else level.convert("RGB")


def _outline(part: NDArray[np.bool_], size: tuple[int, int]) -> Image.Image:
    """A line about one pixel wide along the border of a part [up, across], inside the panel."""
    inside = Image.fromarray(part[::-1].astype(np.uint8) * 255).resize(size, Image.Resampling.BILINEAR)
    filled = Image.fromarray((np.pad(np.asarray(inside) > 127, 1)).astype(np.uint8) * 255)
    line = np.asarray(filled) > np.asarray(filled.filter(ImageFilter.MinFilter(3)))
    return Image.fromarray(line[1:-1, 1:-1].astype(np.uint8) * 255)


def _side_text(picture: Image.Image, at: tuple[int, int], text: str, color: str, size: int) -> None:
    """Write a line upwards, left of a row."""
    if not text:
        return
    font = _font(size)
    left, top, right, bottom = font.getbbox(text)
    label = Image.new("RGB", (int(right - left) + 2, int(bottom - top) + 2), BACKGROUND)
    ImageDraw.Draw(label).text((1 - left, 1 - top), text, color, font=font)
    label = label.rotate(90, expand=True)
    picture.paste(label, (at[0] - label.width // 2, max(0, at[1] - label.height // 2)))


def _bar(picture: Image.Image, at: tuple[int, int], height: int, low: float, high: float) -> None:
    """Draw the colours of a map with the values of both ends and the middle."""
    levels = np.linspace(255, 0, height).round().astype(int)
    picture.paste(Image.fromarray(np.repeat(INFERNO[levels][:, None], 10, axis=1)), at)
    pen = ImageDraw.Draw(picture)
    for share in (0.0, 0.5, 1.0):
        y = at[1] + (1 - share) * height
        pen.text((at[0] + 15, y), f"{low + share * (high - low):.3g}", FAINT_INK, font=_font(13), anchor="lm")


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


def _letter(pen: ImageDraw.ImageDraw, letters: str, box: tuple[int, int, int, int]) -> None:
    """Write the anatomical directions at the four sides, outlined because there may be image below them."""
    x, y, width, height = box
    places = ((x + 4, y + height / 2), (x + width - 4, y + height / 2), (x + width / 2, y + 4))
    for letter, place, anchor in zip(letters, (*places, (x + width / 2, y + height - 4)), _ANCHORS, strict=True):
        pen.text(place, letter, "#e8b04a", font=_font(15), anchor=anchor, stroke_width=2, stroke_fill=BACKGROUND)


_ANCHORS = ("lm", "rm", "mt", "mb")


def _scale_bar(pen: ImageDraw.ImageDraw, left: int, bottom: int, per_mm: float) -> None:
    """Draw a bar of known length in the lower left corner."""
    x, y = left + 8, bottom - 8
    pen.line((x, y, x + SCALE_BAR_MM * per_mm, y), INK, 3)
    pen.text((x, y - 4), f"{SCALE_BAR_MM / 10:.0f} cm", INK, font=_font(14), anchor="lb")
