"""The verdict: its word for each fault, and the order of its reasons."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from g3r.fitting.volume_check import VolumeCheck
from g3r.output.assemble import rollback_warnings
from g3r.output.record import RunRecord
from g3r.planning.anatomy import GENERIC
from g3r.planning.plan import BudgetRecord
from g3r.planning.presets import PRESETS
from g3r.planning.stages import Stage
from g3r.registration.quality import (
    FAILED,
    JUDGED,
    LEFT_OUT,
    NO_SLICE,
    PARALLEL,
    PROBABLY_MIRRORED,
    WITHOUT_SLICES,
    pose_warnings,
)
from g3r.registration.thresholds import MAX_MEDIAN_MOVE_MM
from g3r.report.verdict import verdict_of
from g3r.report.verdict_messages import CHECK, DO_NOT_USE, HEADLINES, MESSAGES, MILDEST_FIRST, USE
from g3r.run.context import StoppedAt
from g3r.uncertainty.unseen import DO_NOT_USE_ABOVE, MENTIONED_ABOVE
from tests.report.records import quality, record, stack, unseen


def test_nothing_wrong_is_use_with_what_speaks_for_it() -> None:
    verdict = verdict_of(record())
    assert verdict.word == USE
    assert verdict.line() == (
        "use: 3 of 3 stacks agree with each other (0.84, 0.84, 0.84; good is 0.68 and above); "
        "slices saw the whole brain"
    )


def stacks_with(one: Any, **more: Any) -> RunRecord:
    return record(stack("a.nii"), stack("b.nii"), one, **more)


def oriented(best: float, rival: float) -> RunRecord:
    """A single stack that fits the template in two orientations."""
    found = record(stack("a.nii", quality(None, None)))
    assert found.registration is not None
    registration = replace(
        found.registration,
        space="standard",
        correlation_with_template=best,
        correlation_of_rival=rival,
        orientation_doubtful=True,
    )
    return replace(found, registration=registration)


def generic(*, n_steps: int, registration: Any = None, **facts: Any) -> RunRecord:
    """Three good stacks of another organ, fitted in a number of steps."""
    asked = PRESETS["fast"]
    found = registration or asked.registration
    search = replace(found, template=False, network=False)
    settings = replace(asked, use_prior=False, anatomy=GENERIC, registration=search)
    return replace(record(), settings=settings, loss={Stage.FIT_TO_SLICES: [{"image": 0.1}] * n_steps}, **facts)


def crossing(angle_deg: float) -> RunRecord:
    """Two stacks whose slices cross at the given angle, with the warning of a run."""
    found = record(stack("a.nii"), stack("b.nii"))
    assert found.registration is not None
    registration = replace(found.registration, crossing_deg=angle_deg)
    return replace(found, registration=registration, warnings=[f"{PARALLEL} (...)"])


def hurried(n_stacks: int) -> RunRecord:
    """A run whose registration was that of `preview`, with a fit after it."""
    found = record(*(stack(f"{n}.nii") for n in range(n_stacks)))
    return replace(found, settings=replace(found.settings, registration=PRESETS["preview"].registration))


CASES: dict[str, tuple[RunRecord, str, str]] = {
    "failed": (
        stacks_with(stack("c.nii", quality(False, 0.31))),
        DO_NOT_USE,
        "c.nii does not fit the other stacks (agreement 0.31; good is 0.65 and above",
    ),
    "mirrored": (
        stacks_with(stack("c.nii", replace(quality(False), handedness=-0.13))),
        DO_NOT_USE,
        "c.nii seems to be a mirror image of what the other stacks show (handedness -0.13; good is above -0.02)",
    ),
    "misfit left out": (
        stacks_with(stack("c.nii", replace(quality(False, 0.31), left_out=True))),
        USE,
        "c.nii was left out: it does not fit the other stacks (agreement 0.31; good is 0.65 and above)",
    ),
    "mirrored left out": (
        stacks_with(stack("c.nii", replace(quality(False), handedness=-0.13, left_out=True))),
        CHECK,
        "c.nii was left out: it is probably a mirror image of what the other stacks show (handedness -0.13)",
    ),
    "not used": (stacks_with(stack("c.nii", WITHOUT_SLICES)), DO_NOT_USE, "c.nii was not used"),
    "doubtful": (stacks_with(stack("c.nii", quality(True, 0.66))), CHECK, "c.nii agrees only just"),
    "doubtful by a hair": (
        stacks_with(stack("c.nii", quality(True, 0.6799))),
        CHECK,
        "c.nii agrees only just with the other stacks (0.67; good is 0.68 and above)",
    ),
    "unlike": (
        stacks_with(stack("c.nii", quality(True, 0.81, 0.82))),
        CHECK,
        "the slices of c.nii agree with the volume by 0.82, those of another stack by 0.95",
    ),
    "jumps": (
        stacks_with(stack("c.nii", quality(True, median_move_mm=MAX_MEDIAN_MOVE_MM + 1.26))),
        CHECK,
        f"the slices of c.nii are placed as if the head had moved by {MAX_MEDIAN_MOVE_MM + 1.3:.1f} mm from one to the",
    ),
    "moves": (stacks_with(stack("c.nii", quality(True, median_move_mm=MAX_MEDIAN_MOVE_MM))), USE, "use: 3 of 3 stacks"),
    "parallel": (
        crossing(13.2),
        CHECK,
        "the slices of all stacks are nearly parallel in the head (13 degrees between them; good is 45 and above)",
    ),
    "single": (record(stack("a.nii", quality(None, None))), CHECK, "single stack"),
    "orientation": (
        oriented(0.682, 0.666),
        CHECK,
        "the head fits the atlas template about as well in another orientation (correlation 0.68, 0.67)",
    ),
    "unseen": (record(unseen=unseen(0.1)), CHECK, "10 % of the brain was not seen"),
    "unseen too much": (
        record(unseen=unseen(DO_NOT_USE_ABOVE + 0.01, usable=False)),
        DO_NOT_USE,
        "31 % of the brain was not seen",
    ),
    "cut": (record(unseen=unseen(usable=False, extent_known=False)), DO_NOT_USE, "the field of view cuts the head"),
    "fallback": (
        record(volume_check=VolumeCheck(volume=0.2, prior=0.1, coarse=0.3)),
        CHECK,
        "the fit made the volume worse",
    ),
    "rollbacks": (record(n_rollbacks=2), CHECK, "step back 2 times"),
    "automatic": (stacks_with(stack("c.nii", mask_from="automatic")), CHECK, "mask of c.nii was found automatically"),
    "small mask": (
        stacks_with(stack("c.nii", left_out_share=0.214)),
        CHECK,
        "the mask of c.nii leaves out 21 % of what the image shows",
    ),
    "file": (
        stacks_with(stack("c.nii", remarks=["sform and qform differ by up to 3 mm; the sform is used"])),
        CHECK,
        "c.nii: sform and qform differ by up to 3 mm",
    ),
    "whole image": (stacks_with(stack("c.nii", mask_from="whole image")), CHECK, "no mask was used for c.nii"),
    "thickness": (
        record(*(stack(f"{n}.nii", thickness_from="spacing") for n in "abc")),
        CHECK,
        "the slice thickness of a.nii, b.nii and c.nii was not stated",
    ),
    "partial": (
        record(partial=True, stopped_at=StoppedAt("fit to slices", 3, 40)),
        CHECK,
        "the run was interrupted in fit to slices, step 3 of 40",
    ),
    "ended early": (record(prior_weight=1.0), CHECK, "the fit had too little time to be shown"),
    "sides": (
        hurried(n_stacks=3),
        CHECK,
        "there was no time to ask whether a stack is a mirror image of the others, or does not belong",
    ),
    "hardly begun": (generic(n_steps=2), CHECK, "the fit had too little time: it ended after 2 steps"),
    "sides of an object": (
        generic(n_steps=100, registration=PRESETS["preview"].registration, time_budget=BudgetRecord(seconds=12.0)),
        CHECK,
        "there was no time to ask whether a stack is a mirror image of the others",
    ),
    "left out": (record(warnings=["d.nii: left out, no head was found"]), CHECK, "d.nii: left out"),
}


@pytest.mark.parametrize("name", CASES)
def test_each_fault_is_said_and_decides(name: str) -> None:
    found, word, words = CASES[name]
    verdict = verdict_of(found)
    assert verdict.word == word
    assert words in verdict.line()
    assert verdict.headline == HEADLINES[verdict.word]
    assert all(reason.advice for reason in verdict.reasons) or name == "left out" or word == USE
    assert "\n" not in verdict.line()


def test_the_way_on_from_an_interrupted_run_is_one_that_there_is() -> None:
    """--resume excludes --time-budget."""
    stopped = record(partial=True, stopped_at=StoppedAt("fit to slices", 3, 40))
    (plain,) = verdict_of(stopped).reasons
    assert "--resume" in plain.advice
    (budgeted,) = verdict_of(replace(stopped, time_budget=BudgetRecord(seconds=20.0))).reasons
    assert budgeted.text == plain.text
    assert "--resume" not in budgeted.advice
    assert "--force" in budgeted.advice


def test_the_worst_comes_first_and_the_line_has_only_that() -> None:
    failed = stack("c.nii", quality(False, 0.2))
    found = record(stack("a.nii", thickness_from="spacing"), stack("b.nii"), failed, unseen=unseen(0.05))
    verdict = verdict_of(found)
    order = [MILDEST_FIRST.index(reason.word) for reason in verdict.reasons]
    assert order == sorted(order, reverse=True)
    assert len(verdict.reasons) == 3
    assert verdict.line().startswith("do not use: c.nii")
    assert "thickness" not in verdict.line()


def test_a_warning_with_words_of_its_own_is_not_said_twice() -> None:
    share = unseen(0.1)
    lines = [
        "c.nii: registration probably failed (correlation ...); do not rely on the volume",
        *rollback_warnings(1),
        str(share.line()),
    ]
    found = stacks_with(stack("c.nii", quality(False, 0.2)), unseen=share, n_rollbacks=1, warnings=lines)
    assert len(verdict_of(found).reasons) == 3


def test_warnings_about_a_quality_are_those_that_the_verdict_says_otherwise() -> None:
    """Each start begins a warning of registration, and the verdict has one reason for it."""
    mirrored = replace(quality(False), handedness=-0.13)
    judged = {
        LEFT_OUT: replace(mirrored, left_out=True),
        NO_SLICE: WITHOUT_SLICES,
        PROBABLY_MIRRORED: mirrored,
        FAILED: quality(False, 0.31),
    }
    assert set(judged) == set(JUDGED)
    for start, one in judged.items():
        named: Any = stack("c.nii", one)
        (line,) = pose_warnings([one], [named])
        assert line.startswith(f"c.nii: {start}")
        found = stacks_with(named)
        assert verdict_of(replace(found, warnings=[line])) == verdict_of(found)


def test_stacks_that_agree_about_as_well_as_each_other_are_not_mentioned() -> None:
    assert verdict_of(stacks_with(stack("c.nii", quality(True, 0.8, 0.9)))).word == USE
    failed = verdict_of(stacks_with(stack("c.nii", quality(False, 0.4, 0.5))))
    assert len(failed.reasons) == 1


def test_what_speaks_for_a_volume_is_said_of_the_stacks_in_it() -> None:
    found = CASES["misfit left out"][0]
    verdict = verdict_of(found)
    n_stacks = len(found.stacks)
    assert f"{n_stacks - 1} of {n_stacks} stacks agree with each other" in verdict.line()
    assert len(verdict.reasons) == 4  # two stacks are left
    mirrored = replace(
        CASES["mirrored left out"][0], warnings=["c.nii: left out of the volume, it is probably a mirror"]
    )
    assert len(verdict_of(mirrored).reasons) == 1


@pytest.mark.parametrize("n_stacks", [1, 2, 3])
def test_two_stacks_are_said_not_to_show_a_mirror_image(n_stacks: int) -> None:
    verdict = verdict_of(record(*(stack(f"{n}.nii") for n in range(n_stacks))))
    said = [reason for reason in verdict.reasons if "mirror image" in reason.text]
    assert len(said) == (n_stacks == 2)
    assert all(reason.word == USE for reason in said)


def test_slivers_are_not_mentioned() -> None:
    assert verdict_of(record(unseen=unseen(MENTIONED_ABOVE / 2))).word == USE


def test_the_table_says_things_in_the_same_form() -> None:
    for name, message in MESSAGES.items():
        assert message.word in MILDEST_FIRST, name
        assert not message.text.endswith("."), name
        assert message.advice == "" or message.advice.endswith("."), name


@pytest.mark.parametrize("n_stacks", [1, 2])
def test_nobody_asks_for_the_sides_of_one_or_two_stacks(n_stacks: int) -> None:
    """More time would not tell either."""
    texts = [reason.text for reason in verdict_of(hurried(n_stacks=n_stacks)).reasons]
    assert not any("there was no time" in text for text in texts)


def test_nobody_asks_for_the_sides_of_a_preview() -> None:
    preview = replace(hurried(n_stacks=3), settings=PRESETS["preview"])
    assert [reason.text.split(":")[0] for reason in verdict_of(preview).reasons] == ["this is a preview"]


def test_a_volume_that_fell_back_to_the_prior_is_not_called_hurried() -> None:
    (reason,) = verdict_of(replace(CASES["fallback"][0], prior_weight=1.0)).reasons
    assert "made the volume worse" in reason.text
