"""Brain masks: their sources, and detection of images that are already brain-extracted."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from g3r.acquisition.cut_images import without_residue
from g3r.acquisition.images import Volume
from g3r.errors import InputError
from g3r.run.provenance import FileHash

MaskSource = Literal["file", "empty background", "whole image", "automatic", "command"]
"""Source of a mask: the user's file, zeros around the brain, `--whole-image`, the mask network, or `--mask-command`."""

MIN_ZERO_SHARE = 0.4
"""A brain-extracted stack has a larger share of zeros than this; stacks with surroundings have far fewer zeros."""

BRAIN_RANGE_ML = (20.0, 900.0)
"""Range of the volume of a fetal or neonatal brain. The tissue in a whole field of view is ten times as large."""

WAYS_ON = (
    "pass --masks with a brain mask for each stack, or --mask-command with a tool that makes them, or --whole-image if "
    "the image shows nothing else"
)


@dataclass(frozen=True, kw_only=True)
class FoundMask:
    """A brain mask and its source.

    Attributes:
        inside: [I, J, K] on the grid of the image's file.
        source: where it comes from.
        detail: network or command, with what it found.
    """

    inside: NDArray[np.bool_]
    source: MaskSource
    detail: str = ""

    def hash(self) -> FileHash:
        """Hash that identifies a mask which is not a file."""
        return FileHash(self.source, hashlib.sha256(np.packbits(self.inside).tobytes()).hexdigest())


def empty_background_mask(volume: Volume) -> FoundMask | None:
    """The positive voxels of a brain-extracted image; None where tissue surrounds the brain.

    Args:
        volume: of a stack.
    """
    value = _cleared(volume)
    positive = value > 0
    if np.count_nonzero(value == 0) <= MIN_ZERO_SHARE * value.size or not positive.any():
        return None
    pieces, _ = label(positive, structure=np.ones((3, 3, 3)))
    largest_ml = np.bincount(pieces[positive]).max() * volume.grid.voxel_volume_mm3 / 1000
    low, high = BRAIN_RANGE_ML
    if not low <= largest_ml <= high:
        return None
    return FoundMask(inside=positive, source="empty background", detail=f"{largest_ml:.0f} ml in the largest piece")


def whole_image(volume: Volume) -> FoundMask:
    """A mask of every positive voxel that is not nearly zero.

    Raises:
        InputError: no voxel is positive.
    """
    positive = _cleared(volume) > 0
    if not positive.any():
        raise InputError(f"{volume.name}: no positive value; expected an image")
    return FoundMask(inside=positive, source="whole image")


def required_mask(volume: Volume) -> FoundMask:
    """The mask of a brain-extracted image.

    Raises:
        InputError: the image shows more than the brain, so a mask has to be given.
    """
    found = empty_background_mask(volume)
    if found is None:
        zeros = 100 * float(np.mean(_cleared(volume) == 0))
        raise InputError(
            f"{volume.name}: no mask says what is to be reconstructed, and the image shows more than that "
            f"({zeros:.0f} % of the voxels are zero; expected over {100 * MIN_ZERO_SHARE:.0f} % and a rest of "
            f"{BRAIN_RANGE_ML[0]:g} to {BRAIN_RANGE_ML[1]:g} ml); {WAYS_ON}"
        )
    return found


def _cleared(volume: Volume) -> NDArray[np.float32]:
    """Values [I, J, K] of an image with zeros for what is nearly zero or not a number."""
    return np.nan_to_num(without_residue(volume.data))
