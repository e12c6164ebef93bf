"""A picture of masks: slices of each stack through its brain, with the outline of the mask."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from g3r.errors import cannot_be_written
from g3r.geometry.grid import bounding_box
from g3r.output.sections import BACKGROUND, FAINT_INK, INK, MARK
from g3r.run.atomic_file import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from g3r.acquisition.stacks import Stack

N_PANELS = 8
"""Slices shown of each stack, from the first with brain to the last."""

PANEL_INCHES = 1.5
DOTS_PER_INCH = 130
MARGIN_MM = 25.0
"""Margin shown around the brain, so that parts missed by a mask are visible."""


def save_mask_picture(path: str | os.PathLike[str], stacks: Sequence[Stack]) -> None:
    """Write a PNG with a row for each stack.

    Args:
        path: the file; it appears whole or not at all.
        stacks: stacks with their masks.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    head = 0.25
    height = len(stacks) * (PANEL_INCHES + head)
    figure = Figure(figsize=(N_PANELS * PANEL_INCHES, height), dpi=DOTS_PER_INCH, facecolor=BACKGROUND)
    panels = figure.subplots(
        len(stacks),
        N_PANELS,
        squeeze=False,
        gridspec_kw={
            "left": 0,
            "right": 1,
            "top": 1 - head / height,
            "bottom": 0,
            "wspace": 0.02,
            "hspace": head / PANEL_INCHES,
        },
    )
    for row, stack in zip(panels, stacks, strict=True):
        _draw_stack(list(row), stack)
    _write(figure, Path(path))


def _draw_stack(panels: list[Axes], stack: Stack) -> None:
    spacing_mm = stack.spacing_mm
    box = bounding_box(stack.mask, np.ceil(MARGIN_MM / spacing_mm).astype(int))
    through = bounding_box(stack.mask)[2]
    numbers = np.unique(np.linspace(through.start, through.stop - 1, N_PANELS).round().astype(int))
    bright = float(np.percentile(stack.image[stack.mask], 99.5))
    for panel, number in zip(panels, numbers, strict=False):
        shown = (box[0], box[1], int(number))
        _draw_slice(panel, stack.image[shown].T, stack.mask[shown].T, bright, float(spacing_mm[1] / spacing_mm[0]))
        panel.text(0.03, 0.03, str(number), color=FAINT_INK, fontsize=7, transform=panel.transAxes)
    for panel in panels:
        panel.axis("off")
    title = f"{stack.name}: brain by {stack.mask_source}, {stack.grid.volume_ml(stack.mask):.0f} ml"
    panels[0].set_title(title, color=INK, fontsize=8, loc="left", pad=3)


def _draw_slice(
    panel: Axes, image: NDArray[np.float32], inside: NDArray[np.bool_], bright: float, aspect: float
) -> None:
    panel.imshow(image, cmap="gray", vmin=0, vmax=bright, origin="lower", aspect=aspect, interpolation="nearest")
    if inside.any() and not inside.all():
        panel.contour(inside, levels=[0.5], colors=MARK, linewidths=0.8)


def _write(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, whole or not at all; raises `InputError` if it cannot be written."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    try:
        with atomic_path(path) as temporary:
            FigureCanvasAgg(figure).print_png(temporary)
    except OSError as error:
        raise cannot_be_written(path, error) from None
