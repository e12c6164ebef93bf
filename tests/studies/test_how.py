"""The moving picture of docs/how.md: its frames, and the published file."""

from __future__ import annotations

import numpy as np
from PIL import Image

from studies.harness import DOCS
from studies.how import fit

MAX_BYTES = 600_000
"""Largest size of the picture, so that the page opens quickly."""


def test_the_picture_in_the_docs_moves_and_is_small() -> None:
    path = DOCS / "images" / "fit.webp"
    assert path.stat().st_size < MAX_BYTES
    with Image.open(path) as image:
        assert getattr(image, "n_frames", 1) == len(fit.SHOWN_STEPS)
        first = np.asarray(image.convert("L"), dtype=float)
        image.seek(image.n_frames - 1)  # type: ignore[attr-defined]
        last = np.asarray(image.convert("L"), dtype=float)
    middle = first.shape[1] // 2
    assert np.abs(first - last)[: fit.HEIGHT, : middle - 40].mean() < 3  # the stack does not change, except by coding
    assert np.abs(first - last)[: fit.HEIGHT, middle:].mean() > 6


def test_slices_stay_bars_and_the_first_column_is_on_the_right() -> None:
    data = np.zeros((4, 3), np.float32)
    data[0, 2] = 1  # the first column, the top slice
    shown = np.asarray(fit.picture(data, (1.0, 3.0)))
    assert shown.shape == (fit.HEIGHT, round(fit.HEIGHT * 4 / 9))
    assert shown[5, -5] == 255
    assert shown[-5, 5] == 0
    assert set(np.unique(shown)) == {0, 255}


def test_a_frame_has_both_pictures_and_their_words() -> None:
    left, right = Image.new("L", (50, fit.HEIGHT), 100), Image.new("L", (70, fit.HEIGHT), 200)
    shown = np.asarray(fit.frame(left, right, ("a stack", "step 1")))
    assert shown.shape == (fit.HEIGHT + fit.CAPTION, 50 + fit.GAP + 70)
    assert shown[10, 10] == 100
    assert shown[10, -10] == 200
    assert shown[fit.HEIGHT :].max() > 100
