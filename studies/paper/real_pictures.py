"""Picture of real stacks: all volumes in the same sections and window, and a held-out slice with its predictions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.evaluation.held_out_stack import PredictedPixels
from g3r.evaluation.metrics import fit_intensity
from g3r.run.atomic_file import atomic_path
from studies.paper.pictures import DPI, PLANES
from studies.tables import new_figure, save_figure

DIFFERENCE_WINDOW = 0.3
"""Difference that has full colour in the map of differences, as a share of the window."""

MARGIN_PIXELS = 4
"""Margin around the brain in a held-out slice."""

Image = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Shown:
    """Data of one method in the picture.

    Attributes:
        planes: the middle slices of its volume in three planes.
        measured: [H, W] the held-out slice, black beside the brain.
        predicted: [H, W] the prediction of that slice by the volume, in the slice's intensities.
    """

    planes: Sequence[Image]
    measured: Image
    predicted: Image

    @classmethod
    def of(cls, volume: Image, mask: NDArray[np.bool_], found: PredictedPixels, k: int) -> Shown:
        """The data of a volume and its prediction.

        Args:
            volume: [I, J, K] on the common grid of all methods.
            mask: [I, J, K] of the brain on that grid.
            found: the prediction.
            k: the slice that is shown.
        """
        middle = [round(float(c)) for c in np.argwhere(mask).mean(0)]
        shown = np.where(mask, volume, 0)
        inside = found.image(found.slices.mask, k)
        measured, predicted = found.image(found.slices.value, k), found.image(found.value, k)
        gain, offset = fit_intensity(predicted, measured, inside)
        cut = _around(inside)
        return cls(
            planes=[np.take(shown, n, axis).T[::-1].astype(np.float32) for axis, n in enumerate(middle)],
            measured=np.where(inside, measured, 0)[cut].astype(np.float32),
            predicted=np.where(inside, predicted * gain + offset, 0)[cut].astype(np.float32),
        )


def largest_slice(found: PredictedPixels) -> int:
    """The slice with the largest brain area, which is the same for every method."""
    return int(np.argmax(np.bincount(found.slices.pixel_plane, minlength=len(found.slices))))


def _around(inside: NDArray[np.bool_]) -> tuple[slice, ...]:
    """The part of a slice that holds the brain."""
    at = np.argwhere(inside)
    low, high = np.maximum(at.min(0) - MARGIN_PIXELS, 0), at.max(0) + MARGIN_PIXELS + 1
    return tuple(slice(a, b) for a, b in zip(low, high, strict=True))


def keep_predictions(path: Path, shown: Mapping[str, Shown]) -> None:
    """Write the data of the picture, so that a later run can draw it.

    Args:
        path: .npz to write.
        shown: by method.
    """
    arrays: dict[str, Any] = {}
    for name, one in shown.items():
        arrays |= {f"{name}/{plane}": image for plane, image in zip(PLANES, one.planes, strict=True)}
        arrays |= {f"{name}/measured": one.measured, f"{name}/predicted": one.predicted}
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)


def draw_real(path: Path, methods: Sequence[str], picture: Path) -> None:
    """A row for each method: three planes, the held-out slice measured and predicted, and their difference.

    Args:
        path: written by `keep_predictions`.
        methods: from top to bottom.
        picture: PNG to write.
    """
    heads = (*PLANES, "held out: measured", "predicted", f"difference, ± {DIFFERENCE_WINDOW:g}")
    figure = new_figure((1.9 * len(heads), 2.0 * len(methods)))
    axes = figure.subplots(len(methods), len(heads), squeeze=False)
    with np.load(path) as data:
        for row, name in enumerate(methods):
            planes = _in_one_window([data[f"{name}/{plane}"] for plane in PLANES])
            measured, predicted = data[f"{name}/measured"], data[f"{name}/predicted"]
            white = np.percentile(measured[measured > 0], 99)
            slices = [measured / white, predicted / white]
            for one, image in zip(axes[row], [*planes, *slices], strict=False):
                one.imshow(image, cmap="gray", vmin=0, vmax=1)
            difference = slices[1] - slices[0]
            axes[row, -1].imshow(difference, cmap="RdBu_r", vmin=-DIFFERENCE_WINDOW, vmax=DIFFERENCE_WINDOW)
            axes[row, 0].set_ylabel(name.replace(", ", ",\n"), fontsize=8)
    for head, one in zip(heads, axes[0], strict=True):
        one.set_title(head, fontsize=8)
    for one in axes.flat:
        one.set_xticks([])
        one.set_yticks([])
        one.set_frame_on(False)
    save_figure(figure, picture, dpi=DPI)


def _in_one_window(images: Sequence[Image]) -> list[Image]:
    """Sections of a volume in arbitrary units, scaled so that its 99th percentile is white."""
    inside = np.concatenate([image[image > 0] for image in images])
    white = np.percentile(inside, 99) if inside.size else 1.0
    return [(image / white).astype(np.float32) for image in images]
