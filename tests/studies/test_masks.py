"""The studies of the mask network: their tables, and what they require."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from g3r.acquisition.slicing import by_headers, slices_from_stacks
from g3r.errors import InputError
from g3r.evaluation.case import load_case
from g3r.mask_network import inference
from studies.harness import Row
from studies.masks import overlap, real, simulated
from studies.masks.surrounded import SLICES_BEYOND, surrounded
from studies.runs import header_error

TRUE = np.ones((1, 3, 3), dtype=bool), (1.0, 1.0, 1.0)


def found_mask(mask: np.ndarray, spacing_mm: np.ndarray) -> inference.BrainMask:
    centre = np.argwhere(mask).mean(0) * spacing_mm if mask.any() else np.full(3, np.nan)
    return inference.BrainMask(
        mask=mask,
        probability=mask.astype(np.float32),
        presence=0.9,
        centre_mm=centre,
        volume_ml=float(mask.sum() * np.prod(spacing_mm) / 1000),
        reason="" if mask.any() else "no head found",
    )


@pytest.fixture
def row(monkeypatch: pytest.MonkeyPatch) -> Row:
    """Row of a mask that is shifted by one pixel and lacks the last slice."""
    true = np.zeros((30, 30, 4), dtype=bool)
    true[5:15, 5:15, 1:4] = True
    found = np.roll(true, 1, axis=0)
    found[:, :, 3] = False
    monkeypatch.setattr(inference, "find_brain", lambda *_: found_mask(found, np.array([1.0, 1.0, 4.0])))
    monkeypatch.setattr(overlap, "mask_model", lambda _: None)
    return overlap.scored(np.zeros((30, 30, 4), np.float32), true, (1.0, 1.0, 4.0), None)


def test_scores_of_a_stack(row: Row) -> None:
    assert row["dice"] == pytest.approx(2 * 180 / 500, abs=1e-4)
    assert row["recall"] == pytest.approx(180 / 300, abs=1e-4)
    assert row["lost_slices"] == 1
    assert row["centre_mm"] == pytest.approx(np.hypot(1.0, 2.0), abs=0.01)
    assert "1 slices lost" in overlap.line("stack", row)


def test_tables_count_found_missed_and_falsely_found_heads(row: Row) -> None:
    without = {"head": False, "found": True, "presence": 0.7, "volume_ml": 11.0, "seconds": 1.0, "reason": ""}
    missed = {**row, "found": False, "centre_mm": None, "dice": 0.0, "lost_slices": 3}
    text = simulated.tables({"rows": {"a": row, "b": missed, "c": without}})["masks-simulated"]
    assert "2 stacks with a head: found in 1, centre within 5 mm in 1" in text
    assert "1 stacks without a head: in 1 of them one was found" in text
    written = {"written": {"a": {"volume_ml": 9.0, **overlap.overlap(np.eye(3, dtype=bool)[None], *TRUE)}}}
    rows = {"a": row, "a, predicted": {"predicted": {"drawn_db": 24.0, "found_db": 23.875}}, "all, written": written}
    shown = real.tables({"rows": rows})
    assert "| a |" in shown["masks-real"]
    assert "predicted" not in shown["masks-real"]
    assert "| a | 0 | 9 | 0.500 | 0.333 | 0 | 24.00 | 23.88 |" in shown["masks-written"]
    assert "0.500" in real.said("all, written", written)
    assert "found 23.88" in real.said("a, predicted", rows["a, predicted"])
    assert "one found" in overlap.line("c", without)


def test_nothing_without_weights(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        overlap.settings(argparse.Namespace(masks=str(tmp_path / "none.safetensors")))


def test_real_stacks_need_data(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("G3R_TEST_DATA", str(tmp_path))
    with pytest.raises(InputError, match="G3R_TEST_DATA"):
        real.stacks_with_masks()
    (tmp_path / "real").mkdir()
    with pytest.raises(InputError, match="no stack with a mask"):
        real.stacks_with_masks()


def test_stacks_in_surroundings_keep_their_brain_in_its_place(subject: Path) -> None:
    case = load_case(subject)
    stacks = surrounded(case, seed=1)
    assert all(stack.image[~stack.mask].any() for stack in stacks)
    slices = by_headers(slices_from_stacks(stacks), stacks)
    moved = replace(slices, slice_index=slices.slice_index - SLICES_BEYOND)
    still, before = case.pose_error(moved), header_error(case)
    assert still.median_mm == pytest.approx(before.median_mm, abs=0.05)
    assert max(still.per_slice_mm.values()) == pytest.approx(max(before.per_slice_mm.values()), abs=0.1)


def test_where_a_slice_ends_within_the_brain_the_brain_goes_on_as_bright_as_the_slice(subject: Path) -> None:
    case = load_case(subject)
    stack = case.stacks[0]
    image, n = stack.image.copy(), stack.image.shape[2] // 2
    image[:, :, n] *= 0.5
    dim = replace(stack, image=image)
    side = int(np.argwhere(stack.mask).mean(0)[0])
    affine = stack.affine.copy()
    affine[:3, 3] += affine[:3, 0] * side
    half = replace(dim, image=image[side:], mask=stack.mask[side:], affine=affine)
    whole, cut = (surrounded(replace(case, stacks=(one, *case.stacks[1:])), seed=1)[0] for one in (dim, half))
    for k in (n, n - 1):
        inside = np.argwhere(cut.mask[:, :, [k + SLICES_BEYOND]]) + np.array([0, 0, k + SLICES_BEYOND])
        assert len(inside) > 1.5 * np.count_nonzero(half.mask[:, :, k])
        place = whole.grid.index(cut.grid.world(inside)).T
        shown, true = (map_coordinates(one.image, at, order=1) for one, at in ((cut, inside.T), (whole, place)))
        assert np.corrcoef(shown, true)[0, 1] > 0.95
        assert shown.mean() == pytest.approx(true.mean(), rel=0.05)


def test_beyond_a_stack_that_ends_within_the_brain_there_is_no_hollow_skull(subject: Path) -> None:
    case = load_case(subject)
    stack = case.stacks[0]
    n = stack.image.shape[2] // 2
    mask = stack.mask.copy()
    mask[:, :, n:] = False
    cut = replace(case, stacks=(replace(stack, mask=mask, image=stack.image * mask), *case.stacks[1:]))
    whole, ends = (surrounded(one, seed=1)[0].image[:, :, SLICES_BEYOND:] for one in (case, cut))
    assert whole[:, :, n].any()
    assert ends[:, :, n - 1].any()
    assert not ends[:, :, n].any()


def test_beyond_the_last_slice_of_a_stack_that_ends_within_the_brain_nothing_is_shown(subject: Path) -> None:
    case = load_case(subject)
    stack = case.stacks[0]
    n = stack.image.shape[2] // 2
    short = replace(stack, image=stack.image[:, :, :n], mask=stack.mask[:, :, :n])
    widened = surrounded(replace(case, stacks=(short, *case.stacks[1:])), seed=1)[0]
    ends = slice(SLICES_BEYOND + n, None)
    assert widened.image[:, :, SLICES_BEYOND + n - 1].any()
    assert not widened.image[:, :, ends].any()
    assert not widened.mask[:, :, ends].any()
