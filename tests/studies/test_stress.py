"""The stress studies: the effect of each damage, and the counts of the tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from g3r.acquisition.stacks import Stack, load_stack
from studies.harness import Row
from studies.stress import damage, drawn, outcome, sweep


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


def test_images_are_cut_where_their_masks_end(stacks: tuple[Stack, ...]) -> None:
    for old, new in zip(stacks, after(damage.images_cut(), stacks), strict=True):
        assert (new.image[~old.mask] == 0).all()
        np.testing.assert_array_equal(new.image[old.mask], old.image[old.mask])


def test_interpolated_images_go_through_the_acquired_pixels(stacks: tuple[Stack, ...]) -> None:
    for old, new in zip(stacks, after(damage.images_interpolated(2), stacks), strict=True):
        np.testing.assert_allclose(new.image[::2, ::2], np.abs(old.image), rtol=1e-4, atol=1e-4 * old.image.max())
        np.testing.assert_allclose(new.grid.world([6, 4, 1]), old.grid.world([3, 2, 1]))
        np.testing.assert_array_equal(new.mask[::2, ::2], old.mask)
        assert new.mask.sum() == pytest.approx(4 * old.mask.sum(), rel=0.02)


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

    assert warning("masks", "-2 pixels", "check: the mask of stack-0.nii.gz leaves out 14 %") == outcome.TRUE
    assert warning("masks", "+2 pixels", "check: the mask of stack-0.nii.gz leaves out 14 %") == outcome.FALSE
    assert warning("one stack", "of another head", "do not use: stack-2.nii.gz does not fit") == outcome.TRUE
    assert warning("one stack", "of another head", "do not use: stack-0.nii.gz does not fit") == outcome.FALSE
    assert warning("gap", "2.2 mm", "check: 3 % of the brain was not seen by any slice (4 ml)") == outcome.TRUE
    assert warning("nothing", sweep.CONDITIONS[0].level, "use: all is well", "use") == "-"


def test_what_is_drawn_is_told_and_can_be_done(stacks: tuple[Stack, ...]) -> None:
    draws = [drawn.drawn(n) for n in range(80)]
    assert draws[:3] == [drawn.drawn(n) for n in range(3)]
    assert {one.n_stacks for one in draws} == {2, 3}
    assert {one.spoilt for one in draws} == {"", *drawn.SPOILT}
    for one in draws:
        assert one.other.volume != one.subject.volume
        assert one.other.acquisition(3)[0].thickness_mm == one.subject.acquisition(3)[0].thickness_mm
        left = stacks
        for each in one.damages():
            left = damage.applied(each, left, stacks, np.random.default_rng(0))
        assert len(left) == one.n_stacks
        assert left[0].thickness_mm == pytest.approx(4.0 * one.stated)
        assert (f"one {one.spoilt}" in one.text()) == bool(one.spoilt)
    specs = [spec for one in draws for spec in (one.subject, one.other)]
    assert len({spec.name for spec in specs}) == len(specs)


def test_the_table_of_draws_counts_stacks_that_were_spoilt() -> None:
    good = {
        "drawn": "",
        "spoilt": "",
        "psnr_db": 30.0,
        "median_mm": 0.1,
        "off_share": 0.0,
        "bad": False,
        "left_out": [],
    }
    use, warned = {"word": "use", "reason": "use: all is well"}, {"word": "check", "reason": "check: b does not fit"}
    rows = [
        good | use,
        good | warned,
        good | warned | {"spoilt": "b"},
        good | use | {"spoilt": "b", "left_out": ["b"]},
        good | use | {"left_out": ["a"]},
        good | use | {"spoilt": "b", "bad": True, "psnr_db": 19.0},
        {"drawn": "", "spoilt": "b", "word": "refused", "reason": "no", "bad": True},
    ]
    record = {"preset": "fast", "rows": {str(n): row for n, row in enumerate(rows)}}
    text = drawn.tables(record)["stress-drawn"]
    assert "7 subjects, 30.00 dB in the median of 6. Of 2 bad ones" in text
    assert "or a refusal, in 1, *check* in 0 and *use* in 1. Of 5 good ones it was *use* in 3, *check* in 2" in text
    assert "1 name what is wrong with the stacks, 1 are false alarms" in text
    assert "Of 4 stacks that do not belong 1 were left out; of 3 sets without one 1 lost a stack." in text
    assert "Where it stayed the verdict was *use* in 1 of 3." in text
    # leaving out a good stack does not hide that the bad one stayed
    worst = good | use | {"spoilt": "b", "left_out": ["a"]}
    more = {str(n): row for n, row in enumerate([*rows, worst])}
    assert "Where it stayed the verdict was *use* in 2 of 4." in drawn.tables(record | {"rows": more})["stress-drawn"]
    masks = good | {"word": "check", "reason": "check: the mask of a leaves out 14 %"}
    for pixels, said in ((2, "0 name what is wrong with the stacks, 1 are"), (-2, "1 name what is wrong")):
        only = {"rows": {"0": masks | {"mask_pixels": pixels}}}
        assert said in drawn.tables(record | only)["stress-drawn"]


def test_cases_choose_conditions_of_each_subject() -> None:
    options = sweep.STUDY.parser().parse_args(["--cases", "noise", "--subjects", "2"])
    expected = [f"noise: SNR {snr} {n}" for n in range(2) for snr in (10, 5)]
    assert [task.key for task in sweep.tasks(options)] == expected
