"""The masks of all stacks: given ones are used, the others are found, and stacks without a brain are left out."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.brain_mask import WAYS_ON, FoundMask, empty_background_mask
from g3r.acquisition.images import Volume, load_volume, names_of
from g3r.errors import InputError

logger = logging.getLogger(__name__)

Masker = Callable[[str | os.PathLike[str], Volume], FoundMask | str]
"""Finds the mask of a stack from its path and its image; returns a reason if there is no brain in it."""

ODD_SIZE = 2.0
"""A found mask this many times larger or smaller than the median of all is not of the same brain."""


@dataclass(frozen=True, kw_only=True)
class MaskedStacks:
    """The stacks that are used, and their masks.

    Attributes:
        kept: numbers of the stacks that are used, from 0.
        masks: mask of each used stack: the user's file, or a found mask.
        left_out: a sentence for each stack that is not used.
    """

    kept: list[int]
    masks: list[str | os.PathLike[str] | FoundMask]
    left_out: list[str]


def find_masks(
    paths: Sequence[str | os.PathLike[str]], given: Sequence[str | os.PathLike[str] | None] | None, masker: Masker
) -> MaskedStacks:
    """The masks of all stacks of a head.

    An image that shows nothing but brain needs no masker.

    Args:
        paths: paths of the stacks.
        given: one file per stack, or None where the mask is to be found; None finds all.
        masker: finds a mask.

    Raises:
        InputError: a stack cannot be read, the masker raises it, or no stack shows a brain.
    """
    files = given or [None] * len(paths)
    masks: dict[int, str | os.PathLike[str] | FoundMask] = {n: own for n, own in enumerate(files) if own is not None}
    # read all stacks first, because making a mask may take minutes
    told = names_of(paths)
    volumes = {n: replace(load_volume(path), name=told[n]) for n, path in enumerate(paths) if n not in masks}
    found_ml: dict[int, float] = {}
    left_out: list[str] = []
    for n, volume in volumes.items():
        found = empty_background_mask(volume) or masker(paths[n], volume)
        if isinstance(found, str):
            left_out.append(f"{volume.name}: left out, {found}")
            continue
        masks[n] = found
        found_ml[n] = volume.grid.volume_ml(found.inside)
        logger.info("%s: mask: %s, %.0f ml (%s)", volume.name, found.source, found_ml[n], found.detail)
    guessed_ml = {n: ml for n, ml in found_ml.items() if _is_guessed(masks[n])}
    for n in _odd_ones(masks, guessed_ml):
        left_out.append(
            f"{volumes[n].name}: left out, what was found in it ({found_ml[n]:.0f} ml) is not as large as in the "
            f"other stacks ({', '.join(f'{ml:.0f}' for m, ml in guessed_ml.items() if m != n)} ml)"
        )
        del masks[n]
    if not masks:
        raise InputError(f"no brain was found in any stack ({'; '.join(left_out)}); {WAYS_ON}")
    kept = sorted(masks)
    return MaskedStacks(kept=kept, masks=[masks[n] for n in kept], left_out=left_out)


def _is_guessed(mask: object) -> bool:
    """Whether a network or a command found the mask; an image without background, or the user's word, is certain."""
    return isinstance(mask, FoundMask) and mask.source in ("automatic", "command")


def _odd_ones(masks: dict[int, str | os.PathLike[str] | FoundMask], found_ml: dict[int, float]) -> list[int]:
    """Stacks with found masks far larger or smaller than the median, if there are three or more.

    A small mask is accepted if it reaches the edge of the image, which then cuts the head.
    """
    if len(found_ml) < 3:
        return []
    typical_ml = float(np.median(list(found_ml.values())))
    odd = []
    for n, own_ml in found_ml.items():
        mask = masks[n]
        assert isinstance(mask, FoundMask)
        too_small = own_ml * ODD_SIZE < typical_ml and not _is_cut(mask.inside)
        if too_small or own_ml > ODD_SIZE * typical_ml:
            odd.append(n)
    return odd


def _is_cut(inside: NDArray[np.bool_]) -> bool:
    """Whether a mask [I, J, K] reaches an end of the image."""
    return any(inside.take(end, axis).any() for axis in range(3) for end in (0, -1))
