"""Holes of the studies: the slices that they remove, and the tables."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.acquisition.stacks import Stack
from studies.harness import Row
from studies.holes import Hole, with_holes
from studies.unseen import sweep
from studies.unseen.fills import FILLS, harmonic


def a_stack(n_slices: int = 20, n_empty: int = 5) -> Stack:
    """A stack whose first and last slices hold no brain."""
    image = np.random.default_rng(0).uniform(1, 2, (6, 6, n_slices)).astype(np.float32)
    mask = np.zeros(image.shape, bool)
    mask[1:5, 1:5, n_empty:-n_empty] = True
    return Stack(image=image, mask=mask, affine=np.diag([1.0, 1.0, 3.0, 1.0]), thickness_mm=3.0)


@pytest.mark.parametrize(
    ("hole", "slices"), [(Hole(1, 0.2, 0.5), [7, 8, 9]), (Hole(1, 0.4, n_slices=2), [9, 10]), (Hole(1, 0.8), [13, 14])]
)
def test_a_hole_is_a_share_of_the_masked_slices(hole: Hole, slices: list[int]) -> None:
    whole = (a_stack(), a_stack())
    first, second = with_holes(whole, [hole])
    assert first is whole[0]
    lost = whole[1].mask.any((0, 1)) & ~second.mask.any((0, 1))
    assert np.flatnonzero(lost).tolist() == slices
    assert not second.image[:, :, slices].any()
    assert second.image.shape == whole[1].image.shape
    assert whole[1].image.all()


def test_the_sweep_has_whole_heads_voids_and_cut_fields_of_view() -> None:
    plans = [sweep.hole_of(n, np.random.default_rng([1, n])) for n in range(sweep.N_SUBJECTS)]
    assert {n_stacks for n_stacks, _ in plans} == {1, 3}
    assert any(not holes for _, holes in plans)
    assert any(hole.n_slices is not None for _, holes in plans for hole in holes)
    assert any(hole.n_slices is None for _, holes in plans for hole in holes)
    assert all(hole.stack < n_stacks for n_stacks, holes in plans for hole in holes)
    again = [sweep.hole_of(n, np.random.default_rng([1, n])) for n in range(sweep.N_SUBJECTS)]
    assert again == plans


def a_row(median_mm: float, volume_error: float, warned: bool, unseen_db: float | None) -> Row:
    scores = {name: {"whole": 22.0} | ({} if unseen_db is None else {"unseen": unseen_db}) for name in FILLS}
    return {
        "unseen_share": 0.1,
        "stated_share": 0.1,
        "median_mm": median_mm,
        "p90_mm": median_mm,
        "volume_error": volume_error,
        "scores": scores,
        "calibration": {} if unseen_db is None else {"unseen": 1.2},
        "warned": warned,
        "seconds": 1.0,
    }


def test_the_sweep_counts_what_is_good_and_what_is_silent() -> None:
    rows = {
        "good": a_row(0.3, 0.01, False, 20.0),
        "bad and silent": a_row(2.0, 0.05, False, 18.0),
        "bad and warned": a_row(2.0, -0.05, True, None),
    }
    text = sweep.tables({"rows": rows})["unseen-sweep"]
    assert "3 subjects, 2 with an unseen part" in text
    assert "Brain volume within 3% of the truth: 1 of 3" in text
    assert "under 1 mm: 1 of 3; of the others 1 without a warning" in text
    assert "| volume | 19.00 | 22.00 |" in text


def test_harmonic_fill_continues_a_linear_volume() -> None:
    values = np.fromfunction(lambda i, j, k: i + 2 * j - k, (12, 11, 10))
    hole = np.zeros(values.shape, bool)
    hole[4:8, 3:7, 2:7] = True
    np.testing.assert_allclose(harmonic(np.where(hole, 0, values), hole), values, atol=0.02)
    assert np.array_equal(harmonic(values, np.zeros(values.shape, bool)), values)
