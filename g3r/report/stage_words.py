"""Progress messages of a run on the terminal: every sentence about a stage is in `DOING` and `LINES`.

The verdict at the end has its own table, in `verdict_messages.py`. Nothing heavy is imported here: the first message
is printed before torch is loaded.
"""

from __future__ import annotations

from collections.abc import Mapping

STARTING, FINDING_MASKS, LOADING, PREPARING = "starting", "finding masks", "loading", "preparing"
"""Steps before the stages of the run context: files are checked and read, programs are loaded."""

WRITING = "writing"
"""Step after the stages of the run context."""

DOING = {
    STARTING: "starting",
    FINDING_MASKS: "finding the brain",
    LOADING: "reading the stacks",
    PREPARING: "loading the programs",
    "registration": "finding the head",
    "masks": "outlining the brain",
    "coarse volume": "first volume",
    "prior": "comparing with other brains",
    "slices to prior": "following the motion",
    "poses in rounds": "following the motion",
    "fit to prior": "building the volume",
    "held-out slices": "testing the slice thickness",
    "fit to slices": "fitting to the slices",
    "volume": "making the volume",
    "prior share": "checking what was measured",
    "uncertainty": "estimating the errors",
    WRITING: "writing the files",
}
"""Words by stage: shown beside the bar, and before the sentence when the stage has ended."""

LINES = {
    "stacks": (LOADING, "{n_stacks:stack}, {n_slices:slice} {thickness} thick"),
    "slices": (LOADING, "{n_slices:slice} with given poses, in {n_stacks:stack} by {by}"),
    "thickness unknown": (LOADING, "the thickness of {n:stack} is not stated: look at the warnings"),
    "masks given": (FINDING_MASKS, "your {n_given:mask} will be used"),
    "masks found": (FINDING_MASKS, "found in {n_found} of {n_stacks:stack}; look at masks.png"),
    "masks mixed": (FINDING_MASKS, "your masks for {n_given:stack}, found in {n_found:more}; look at masks.png"),
    "whole image": (FINDING_MASKS, "no masks: the whole image is taken for brain"),
    "head found": ("registration", "found, {n_agree} of {n_stacks:stack} agree"),
    "head doubtful": ("registration", "only {n_agree} of {n_stacks:stack} agree"),
    "head lost": ("registration", "not found: the {n_stacks:stack} do not agree"),
    "head alone": ("registration", "a single stack, which no other stack checks"),
    "placed": ("poses in rounds", "{n_slices:slice} show brain, moved by {median} mm, at most {most} mm"),
    "masks refined": ("masks", "compared between stacks, {n_changed} of {n_stacks:mask} differed"),
    "coarse": ("coarse volume", "a blurred volume of {n_slices:slice}"),
    "prior used": ("prior", "used where slices say little"),
    "prior unused": ("prior", "not done; the slices alone decide"),
    "moved to prior": ("slices to prior", "the slices move to fit other brains"),
    "not moved to prior": ("slices to prior", "the slices stay where they were"),
    "rounds helped": ("poses in rounds", "done again, stacks agree better ({before} to {after})"),
    "rounds helped little": ("poses in rounds", "done again, stacks agree about as before ({before}, then {after})"),
    "rounds undone": ("poses in rounds", "done again, which did not help and was undone"),
    "rounds alone": ("poses in rounds", "done again with the volume so far"),
    "gaussians": ("fit to prior", "made of {n:Gaussian}"),
    "width narrower": ("held-out slices", "slices act {percent} % thinner than stated"),
    "width wider": ("held-out slices", "slices act {percent} % thicker than stated"),
    "width as stated": ("held-out slices", "slices act as thick as stated"),
    "width unclear": ("held-out slices", "no clear answer; a usual one is taken"),
    "fitted": ("fit to slices", "{n_trusted} of {n_slices:slice} fit well"),
    "volume": ("volume", "{voxel} mm voxels, a brain of {volume} ml"),
    "volume unseen": ("volume", "{voxel} mm voxels, a brain of {volume} ml, {unseen} % of it unseen"),
    "shares": ("prior share", "prior_share.nii.gz says it of each voxel"),
    "errors": ("uncertainty", "uncertainty.nii.gz says them of each voxel"),
    "written": (WRITING, "done"),
}
"""Lines by name: the stage, and the sentence when it has ended. `{n:stack}` is "1 stack" or "3 stacks"."""

WITHOUT_FACTS = {"prior share": "shares", "uncertainty": "errors"}
"""Stages with one fixed line, whatever their result."""

RESUMED = " (from the earlier run)"

COMPILING = "first run on this machine: programs are compiled once, about {seconds} s"


STOPPING = "stopping after this step"
"""Shown beside the bar after a first Ctrl-C."""


class Count(int):
    """A number of things that is formatted with their name, in the singular or the plural."""

    def __format__(self, name: str) -> str:
        """The number and the name, as "1 stack" or "3 stacks"; the number alone without a name."""
        if not name:
            return str(int(self))
        return f"{int(self)} {name}" if int(self) == 1 or name in ("more",) else f"{int(self)} {name}s"


def line(name: str, facts: Mapping[str, object], *, resumed: bool = False) -> str:
    """A line of the table, filled in.

    Args:
        name: key of `LINES`.
        facts: values to fill in.
        resumed: whether the stage was taken from an earlier run.
    """
    stage, text = LINES[name]
    counted = {key: Count(value) if isinstance(value, int) else value for key, value in facts.items()}
    return f"{DOING[stage]}: {text.format(**counted)}{RESUMED if resumed else ''}"
