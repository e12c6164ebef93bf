"""Pictures of measured slices, of their prediction from the volume, and of the difference: the worst first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.images import Volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.output.files import FULL_WEIGHT
from g3r.report.pictures import difference, grey
from g3r.report.slice_rows import SliceRows

MAX_SHOWN = 12


@dataclass(frozen=True, kw_only=True)
class SlicePicture:
    """The pictures of one slice.

    Attributes:
        stack: name of its file.
        number: number in the stack, counted from 0 as in slices.tsv.
        weight, ncc: weight in the volume and correlation with it.
        reason: why it is down-weighted.
        measured, predicted, difference: PNG pictures as base64.
    """

    stack: str
    number: int
    weight: float
    ncc: float
    reason: str
    measured: str
    predicted: str
    difference: str


def worst_first(rows: SliceRows) -> NDArray[np.int64]:
    """Indices of the `MAX_SHOWN` slices to look at.

    Those of the lowest weight come first, then those of the lowest correlation; small slices after the others.
    """
    small = np.array(["small" in reason for reason in rows.reason], dtype=bool)
    kind = np.where(rows.weight >= FULL_WEIGHT, 2, small)
    return np.lexsort((rows.ncc, np.round(rows.weight, 2), kind))[:MAX_SHOWN]


def slice_pictures(slices: Slices, rows: SliceRows, names: list[str], volume: Volume) -> list[SlicePicture]:
    """Pictures of the worst slices; the prediction is scaled by one gain, so that the difference shows no gain error.

    Args:
        slices: [K] in their final poses, with their pixels.
        rows: [K] rows of slices.tsv.
        names: names of the stacks.
        volume: the written volume, in the space of the poses.
    """
    chosen = worst_first(rows)
    some = slices.take(chosen)
    predicted = VoxelOperator(some.planes, volume.grid).forward(np.nan_to_num(volume.data))
    found = []
    for n, k in enumerate(chosen.tolist()):
        part = slice(int(some.planes.offset[n]), int(some.planes.offset[n + 1]))
        shape = tuple(some.planes.shape[n].tolist())
        inside = some.mask[part]
        measured, expected = some.value[part] * inside, predicted[part] * inside
        power = float(expected @ expected)
        expected = expected * np.float32(expected @ measured / power if power > 0 else 1.0)
        high = float(np.percentile(measured[inside], 99.5)) if inside.any() else 1.0
        high = high if high > 0 else 1.0
        found.append(
            SlicePicture(
                stack=names[int(rows.stack[k])],
                number=int(rows.number[k]),
                weight=float(rows.weight[k]),
                ncc=float(rows.ncc[k]),
                reason=rows.reason[k] if rows.weight[k] < FULL_WEIGHT else "used in full",
                measured=grey(measured.reshape(shape).T, 0.0, high),
                predicted=grey(expected.reshape(shape).T, 0.0, high),
                difference=difference((measured - expected).reshape(shape).T, high),
            )
        )
    return found
