"""The messages of a verdict: its words, every reason, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

Word = Literal["use", "check", "do not use"]

USE: Final = "use"
CHECK: Final = "check"
DO_NOT_USE: Final = "do not use"

MILDEST_FIRST: tuple[Word, ...] = (USE, CHECK, DO_NOT_USE)


@dataclass(frozen=True)
class Message:
    """A reason that a verdict may have.

    Attributes:
        word: the best verdict that is possible with this message.
        text: the fact; values replace the names in braces.
        advice: what to do about it.
    """

    word: Word
    text: str
    advice: str


MESSAGES = {
    "stack failed": Message(
        DO_NOT_USE,
        "{stack} does not fit the other stacks ({shortfalls})",
        "Leave that stack out and run again, or check that it shows the same head and that its mask is right.",
    ),
    "stack mirrored": Message(
        DO_NOT_USE,
        "{stack} seems to be a mirror image of what the other stacks show (handedness {handedness}; good is above "
        "{good:g})",
        "Slices may be in reverse order, or a header may swap two sides, of this stack or of the others: what is shown "
        "as left may be right. Find out which one is wrong, leave it out, and run again.",
    ),
    "mirrored left out": Message(
        CHECK,
        "{stack} was left out: {why}",
        "Slices may be in reverse order, or a header may swap two sides, of this stack or of the others: what is shown "
        "as left may be right. Find out which one is wrong.",
    ),
    "stack not used": Message(
        DO_NOT_USE,
        "{stack} was not used: no slice has enough pixels in its mask",
        "Check its mask, or leave the stack out and run again.",
    ),
    "unseen too much": Message(
        DO_NOT_USE, "{line}", "Acquire slices that cover the missing part, or add another stack."
    ),
    "stack doubtful": Message(
        CHECK,
        "{stack} agrees only just with the other stacks ({agreement}; good is {good:g} and above)",
        "Look for doubled edges in the volume, and at the slices below.",
    ),
    "stack unlike others": Message(
        CHECK,
        "the slices of {stack} agree with the volume by {ncc}, those of another stack by {best}",
        "Check that the stack shows the same head on the same day, and look at its slices below.",
    ),
    "stack jumps": Message(
        CHECK,
        "the slices of {stack} are placed as if the head had moved by {mm} mm from one to the next (median; good is "
        "{good:g} and below)",
        "Heads move less from one slice to the next. Slices may be in wrong places, or in an order that g3r does not "
        "try: look for doubled edges in the volume, and at the slices below.",
    ),
    "unseen": Message(CHECK, "{line}", "Nothing can be said of a lesion there; the part is outlined in the viewer."),
    "volume check": Message(CHECK, "{line}", "Look at the slices below: measured and predicted should be alike."),
    "rollbacks": Message(
        CHECK, "the fit had to step back {n} times because its error rose", "Look at the whole volume for streaks."
    ),
    "single stack": Message(
        CHECK,
        "there is a single stack: nothing checks where its slices were put, nor which way the head lies",
        "Compare the volume with the stack; two more stacks in other planes make it far safer.",
    ),
    "stacks parallel": Message(
        CHECK,
        "the slices of all stacks are nearly parallel in the head ({angle} degrees between them; good is {good:.0f} "
        "and above): across their slices the stacks do not check each other, though they agree",
        "The head may have turned between stacks. Lengths and shapes across the slices may be wrong by millimetres; "
        "add a stack in another plane.",
    ),
    "orientation doubtful": Message(
        CHECK,
        "the head fits the atlas template about as well in another orientation (correlation {best}, {rival})",
        "What is shown as left, front or top may be something else: compare the volume with the stack.",
    ),
    "masks found": Message(
        CHECK,
        "the brain {masks} of {stacks} {were} found automatically",
        "Look at masks.png: a mask that misses brain or takes in face leads registration astray.",
    ),
    "whole image": Message(
        CHECK, "no mask was used for {stacks}: the whole image was taken for brain", "Check that only brain is shown."
    ),
    "file doubtful": Message(
        CHECK,
        "{stack}: {remark}",
        "The volume follows the file as it is: compare sides and sizes with the scanner's own pictures, or export the "
        "file again.",
    ),
    "mask too small": Message(
        CHECK,
        "the mask of {stack} leaves out {share} of what the image shows, and nothing but a brain seems to be in it",
        "Look whether the mask ends inside the brain: what it leaves out is not in the volume.",
    ),
    "thickness assumed": Message(
        CHECK,
        "the slice thickness of {stacks} was not stated; the distance of slices was taken ({mm} mm)",
        "If there was a gap or an overlap, run again with --thickness: it decides how sharp the volume is.",
    ),
    "partial": Message(
        CHECK,
        "the run was {where}: this is the volume so far, without uncertainty",
        "Finish it with --resume before using it.",
    ),
    "partial of a budget": Message(
        CHECK,
        "the run was {where}: this is the volume so far, without uncertainty",
        "A run with --time-budget keeps no stages: run it again from the start, with --force, before using it.",
    ),
    "not fitted": Message(
        CHECK,
        "there was no time for a fit: this is {what}, without uncertainty",
        "Run again with a longer --time-budget, or without one, before reading it.",
    ),
    "fit ended early": Message(
        CHECK,
        "the fit had too little time to be shown: this is the prior volume alone",
        "Run again with a longer --time-budget, or without one, before reading it.",
    ),
    "fit hardly begun": Message(
        CHECK,
        "the fit had too little time: it ended after {steps} steps",
        "Run again with a longer --time-budget, or without one, before reading it.",
    ),
    "sides not compared": Message(
        CHECK,
        "there was no time to ask whether a stack is a mirror image of the others, or does not belong to them",
        "Run again with a longer --time-budget, or without one, before trusting left and right.",
    ),
    "preview": Message(
        CHECK, "this is a preview: {what}, without uncertainty", "Run again with another --preset before reading it."
    ),
    "warning": Message(CHECK, "{line}", ""),
    "two stacks": Message(
        USE,
        "two stacks do not show whether one of them is a mirror image of the other",
        "Slices in reverse order or a header that swaps two sides would do it. Compare both where the head is not "
        "symmetric, or add a third stack.",
    ),
    "left out": Message(
        USE,
        "{stack} was left out: {why}",
        "Nothing of it is in the volume. Check that it shows the same head, and that its mask is right.",
    ),
    "all agree": Message(
        USE, "{n} of {all} stacks agree with each other ({agreement}; good is {good:g} and above)", ""
    ),
    "all seen": Message(USE, "slices saw the whole {what}", ""),
}
"""Messages of terminal and report, by name."""

HEADLINES = {
    USE: "No fault was found by the checks that g3r makes.",
    CHECK: "Look at the points below before using this volume.",
    DO_NOT_USE: "This volume must not be used.",
}
"""Meaning of the words."""
