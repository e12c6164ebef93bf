"""Pictures of docs/paper.md: the same slices of every method in the same window, with maps of the error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.evaluation.case import SimulatedCase
from g3r.run.atomic_file import atomic_path
from studies.tables import new_figure, save_figure

TRUTH = "truth"

ERROR_WINDOW = 0.25
"""Error that is white in the map of errors, as a share of the data range."""

DPI = 72
"""Resolution of the PNG. Slices have about a hundred pixels, so more would only make larger files."""

PLANES = ("sagittal", "coronal", "axial")


def keep_sections(path: Path, case: SimulatedCase, volumes: Mapping[str, NDArray[np.float32]]) -> None:
    """Write the middle slices of volumes in three planes, in units of the data range of the truth.

    Args:
        path: .npz to write, with an array [3 planes] per method, zero-padded to one size.
        case: with the truth and its mask.
        volumes: [I, J, K] on the truth's grid, by method.
    """
    mask, truth = case.truth_mask, case.truth.data
    data_range = float(np.percentile(truth[mask], 99.9))
    middle = [round(float(c)) for c in np.argwhere(mask).mean(0)]
    size = max(mask.shape)

    def three(volume: NDArray[np.floating]) -> NDArray[np.float16]:
        out = np.zeros((3, size, size), np.float16)
        for axis, n in enumerate(middle):
            section = np.take(np.where(mask, volume, 0) / data_range, n, axis).T[::-1]
            low = [(size - length) // 2 for length in section.shape]
            out[axis, low[0] : low[0] + section.shape[0], low[1] : low[1] + section.shape[1]] = section
        return out

    arrays: dict[str, Any] = {TRUTH: three(truth)} | {name: three(volume) for name, volume in volumes.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)


def draw_methods(sections: Path, methods: Sequence[str], path: Path, titles: Mapping[str, str]) -> None:
    """Truth and methods in columns; a row of slices and a row of errors for two planes.

    Args:
        sections: written by `keep_sections`.
        methods: names, from left to right; methods that the file lacks are left out.
        path: of the PNG.
        titles: a second line below a method's name, such as its score.
    """
    with np.load(sections) as data:
        found = {name: data[name].astype(np.float32) for name in (TRUTH, *methods) if name in data}
    planes = (2, 1)
    figure = new_figure((1.75 * len(found), 7.6))
    axes = figure.subplots(2 * len(planes), len(found), squeeze=False)
    for column, (name, images) in enumerate(found.items()):
        for row, plane in enumerate(planes):
            above, below = axes[2 * row, column], axes[2 * row + 1, column]
            above.imshow(images[plane], cmap="gray", vmin=0, vmax=1)
            error = np.abs(images[plane] - found[TRUTH][plane])
            if name == TRUTH:
                below.text(0.5, 0.5, f"error,\nwhite: {ERROR_WINDOW:g}", ha="center", va="center", fontsize=8)
            else:
                below.imshow(error, cmap="inferno", vmin=0, vmax=ERROR_WINDOW)
            for one in (above, below):
                one.set_xticks([])
                one.set_yticks([])
                one.set_frame_on(False)
        head = name.replace(", ", ",\n")
        axes[0, column].set_title(f"{head}\n{titles.get(name, '')}", fontsize=8)
    for row, plane in enumerate(planes):
        axes[2 * row, 0].set_ylabel(PLANES[plane], fontsize=8)
    save_figure(figure, path, dpi=DPI)
