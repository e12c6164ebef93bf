"""The study of what goes wrong: each damage does what it says, and its table counts right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from g3r.acquisition.stacks import Stack, load_stack
from studies.harness import Row
from studies.stress import damage, sweep


@pytest.fixture(scope="module")
def stacks(subject: Path) -> tuple[Stack, ...]:
    """Three small stacks."""
    return tuple(load_stack(subject / f"stack-{n}.nii.gz", subject / f"mask-{n}.nii.gz", 4.0) for n in range(3))


def after(one: damage.Damage, stacks: tuple[Stack, ...]) -> tuple[Stack, ...]:
    return damage.applied(one, stacks, stacks[::-1], np.random.default_rng(0))


def n_slices(stack: Stack) -> int:
    return int(stack.mask.any((0, 1)).sum())


def test_fewer_stacks_slices_and_pixels(stacks: tuple[Stack, ...]) -> None:
    assert len(after(damage.first_stacks(2), stacks)) == 2
    for old, new in zip(stacks, after(damage.span_lost(1 / 3), stacks), strict=True):
        assert n_slices(new) == n_slices(old) - round(n_slices(old) / 3)
        ends = np.flatnonzero(old.mask.any((0, 1)))[[0, -1]]
        assert new.mask[:, :, ends].any((0, 1)).all()
    kept = sum(map(n_slices, after(damage.slices_lost(0.2), stacks))) / sum(map(n_slices, stacks))
    assert 0.6 < kept < 0.95
    for pixels in (-2, 2):
        for old, new in zip(stacks, after(damage.masks_grown(pixels), stacks), strict=True):
            large, small = (new, old) if pixels > 0 else (old, new)
            assert not (small.mask & ~large.mask).any()
            assert large.mask.sum() > small.mask.sum()


def test_headers_and_single_stacks(stacks: tuple[Stack, ...]) -> None:
    assert [one.thickness_mm for one in after(damage.stated_thickness(0.7), stacks)] == pytest.approx([2.8] * 3)
    first, second, last = after(damage.slices_reversed(), stacks)
    assert (first, second) == stacks[:2]
    np.testing.assert_array_equal(last.image, np.flip(stacks[2].image, 2))
    order = after(damage.halves_swapped(), stacks)[2]
    np.testing.assert_array_equal(order.image[:, :, 1], stacks[2].image[:, :, 2])
    assert after(damage.stack_of_another(), stacks)[2] is stacks[0]
    inside = stacks[2].mask & (stacks[2].image > 0)
    dark = after(damage.other_contrast(), stacks)[2].image[inside]
    assert np.corrcoef(dark, stacks[2].image[inside])[0, 1] < -0.9


def test_conditions_have_names_of_their_own_and_the_same_head() -> None:
    names = [one.name for one in sweep.CONDITIONS]
    assert len(set(names)) == len(names)
    specs = [sweep.subject_of(one, 1) for one in sweep.CONDITIONS]
    assert {(one.volume, one.seed) for one in specs} == {("crl-sta/sta30", sweep.FIRST_SEED + 1)}
    assert len({one.name for one in specs}) == len({(one.motion, str(one.taken)) for one in specs})
    taken = next(one for one in specs if one.taken)
    assert all(getattr(one, key) == value for one in taken.acquisition(3) for key, value in taken.taken.items())


def test_the_table_counts_words_by_what_they_were_said_of() -> None:
    def row(word: str, bad: bool) -> Row:
        figures = {"psnr_db": 30.0, "median_mm": 0.1, "off_share": 0.0}
        return {
            "what": "nothing",
            "level": sweep.CONDITIONS[0].level,
            "word": word,
            "reason": word,
            "bad": bad,
        } | figures

    words = [("use", False), ("use", False), ("check", False), ("do not use", True), ("refused", True), ("use", True)]
    rows = {str(n): row(*one) for n, one in enumerate(words)}
    rows["5"]["left_out"] = [sweep.LAST]
    rows["7"] = rows["5"] | {"what": sweep.ONE_STACK, "level": "of another head", "left_out": ["stack-0.nii.gz"]}
    rows["6"] = rows["5"] | {"what": sweep.ONE_STACK, "level": "of another head", "bad": False}
    text = sweep.tables({"preset": "fast", "rows": rows})["stress-sweep"]
    assert "Of 4 bad ones the verdict was *do not use*, or a refusal, in 2, *check* in 0 and *use* in 2." in text
    assert (
        text.partition("|")[0].strip().endswith("In 3 runs a stack was left out, in 1 of these the one that was wrong.")
    )
    assert "Of 4 good ones it was *use* in 3, *check* in 1 and *do not use* in 0; " in text
    assert "0 name what is wrong with the stacks, 1 are false alarms." in text


def test_a_warning_that_names_the_fault_is_no_false_alarm() -> None:
    def warning(what: str, level: str, reason: str, word: str = "check") -> str:
        row = {"what": what, "level": level, "word": word, "reason": reason, "bad": False}
        return sweep.table([row], {"warning": sweep.EACH["warning"]}).splitlines()[-1].strip("| ")

    assert warning("masks", "-2 pixels", "check: the mask of stack-0.nii.gz leaves out 14 %") == sweep.TRUE
    assert warning("masks", "+2 pixels", "check: the mask of stack-0.nii.gz leaves out 14 %") == sweep.FALSE
    assert warning("one stack", "of another head", "do not use: stack-2.nii.gz does not fit") == sweep.TRUE
    assert warning("one stack", "of another head", "do not use: stack-0.nii.gz does not fit") == sweep.FALSE
    assert warning("gap", "2.2 mm", "check: 3 % of the brain was not seen by any slice (4 ml)") == sweep.TRUE
    assert warning("nothing", sweep.CONDITIONS[0].level, "use: all is well", "use") == "-"
