"""Small PNG pictures of the page, as text (base64)."""

from __future__ import annotations

import base64
import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

DIFFERENCE_SHARE = 0.3
"""Share of the white level at which a difference has its full colour."""

SMALLEST_PIXELS = 96
"""Least width; smaller pictures are enlarged."""


def grey(section: NDArray[np.float32], low: float, high: float) -> str:
    """A section [up, across] in grey, first row at the bottom; `low` is black and `high` is white."""
    return _png(_bytes((section - low) / (high - low)))


def central_sections(
    volume: NDArray[np.float32], index: NDArray[np.float64], low: float, high: float
) -> tuple[tuple[str, str], ...]:
    """Name and picture of the axial, the coronal and the sagittal section; the patient's right is on the left.

    Args:
        volume: [I, J, K], axes along RAS.
        index: [3] of the voxel through which the sections go, rounded.
        low: intensity shown as black.
        high: intensity shown as white.
    """
    i, j, k = np.rint(index).astype(int).tolist()
    found = (("axial", volume[::-1, :, k]), ("coronal", volume[::-1, j, :]), ("sagittal", volume[i, ::-1, :]))
    return tuple((name, grey(section.T, low, high)) for name, section in found)


def difference(section: NDArray[np.float32], high: float) -> str:
    """Signed errors [up, across]: brighter than predicted in orange, darker in blue, none in black.

    Args:
        section: measured minus predicted, first row at the bottom.
        high: intensity shown as white in the pictures beside it.
    """
    share = np.clip(section / (DIFFERENCE_SHARE * high), -1, 1)[..., None]
    orange, blue = np.array([1.0, 0.62, 0.22]), np.array([0.3, 0.62, 1.0])
    return _png(_bytes(np.where(share > 0, share * orange, -share * blue)))


def _bytes(share: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.rint(255 * np.clip(np.nan_to_num(share), 0, 1)).astype(np.uint8)


def _png(pixels: NDArray[np.uint8]) -> str:
    image = Image.fromarray(np.ascontiguousarray(pixels[::-1]))
    if image.width < SMALLEST_PIXELS:
        scale = -(-SMALLEST_PIXELS // image.width)
        image = image.resize((image.width * scale, image.height * scale), Image.Resampling.BICUBIC)
    stream = io.BytesIO()
    image.save(stream, "PNG")
    return base64.b64encode(stream.getvalue()).decode("ascii")
