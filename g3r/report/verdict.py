"""The verdict on a volume for terminal and report, "use", "check" or "do not use", with its reasons.

Every sentence is in `verdict_messages`. The thresholds are in the code that applies them: `registration.thresholds`,
`uncertainty.unseen` and `fitting.volume_check`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from g3r.fitting.prior_weight import ended_early
from g3r.output.record import LOSS_ROSE
from g3r.planning.anatomy import NAME_OF
from g3r.planning.stages import Stage
from g3r.registration.quality import JUDGED, PARALLEL, misfit, nearly_parallel
from g3r.registration.stack_quality import is_mirrored, rounded_down, shortfalls, unlike_others
from g3r.registration.thresholds import MAX_MEDIAN_MOVE_MM, MIN_CROSSING_DEG, MIRRORED_BELOW, RETRY_BELOW_CORRELATION
from g3r.report.verdict_messages import HEADLINES, MESSAGES, MILDEST_FIRST, USE, Word

if TYPE_CHECKING:
    from g3r.output.record import RunRecord
    from g3r.output.stack_record import StackRecord


@dataclass(frozen=True)
class Reason:
    """One message of the table, filled in."""

    word: Word
    text: str
    advice: str

    @property
    def sentence(self) -> str:
        """The text as a sentence with a capital and a full stop; a file name at its beginning stays unchanged."""
        first = self.text.split()[0]
        text = self.text if "." in first else self.text[0].upper() + self.text[1:]
        return text if text.endswith(".") else f"{text}."


@dataclass(frozen=True)
class Verdict:
    """The word and its reasons, the worst first; for "use", the reasons in favour."""

    word: Word
    reasons: tuple[Reason, ...]

    @property
    def headline(self) -> str:
        """The meaning of the word, as a sentence."""
        return HEADLINES[self.word]

    @property
    def deciding(self) -> list[str]:
        """The reasons that are as severe as the word."""
        return [reason.text for reason in self.reasons if reason.word == self.word]

    def line(self) -> str:
        """The word and the deciding reasons in one line, for the terminal."""
        return f"{self.word}: {'; '.join(self.deciding)}"


def verdict_of(record: RunRecord) -> Verdict:
    """Judge a result by its run.json."""
    told = sorted((_reason(*one) for one in _faults(record)), key=lambda one: -MILDEST_FIRST.index(one.word))
    if told and told[0].word != USE:
        return Verdict(told[0].word, tuple(told))
    used = _used(record)
    facts = {"n": len(used), "all": len(record.stacks), "agreement": ", ".join(map(_agreement, used))}
    good = _reason("all agree", facts | {"good": RETRY_BELOW_CORRELATION})
    return Verdict(USE, (good, *told, _reason("all seen", {"what": NAME_OF[record.settings.anatomy]})))


def _reason(name: str, facts: dict[str, object]) -> Reason:
    message = MESSAGES[name]
    return Reason(message.word, message.text.format(**facts), message.advice)


def _faults(record: RunRecord) -> Iterator[tuple[str, dict[str, object]]]:
    """Names of messages, and the values to fill in."""
    for stack in record.stacks:
        yield from _of_stack(stack)
    yield from _unlike_others(record)
    unseen = record.unseen.line() if record.unseen else None
    if record.unseen and unseen:
        yield "unseen" if record.unseen.usable else "unseen too much", {"line": unseen}
    checked = record.volume_check.line() if record.volume_check else ""
    if checked:
        yield "volume check", {"line": checked}
    if record.n_rollbacks:
        yield "rollbacks", {"n": record.n_rollbacks}
    if len(record.stacks) == 1:
        yield "single stack", {}
    elif len(_used(record)) == 2 and not any(stack.quality and is_mirrored(stack.quality) for stack in record.stacks):
        yield "two stacks", {}
    found = record.registration
    if found and nearly_parallel(found.crossing_deg):
        yield "stacks parallel", {"angle": f"{found.crossing_deg:.0f}", "good": MIN_CROSSING_DEG}
    if found and found.orientation_doubtful:
        best, rival = found.correlation_with_template, found.correlation_of_rival
        yield "orientation doubtful", {"best": f"{best:.2f}", "rival": f"{rival:.2f}"}
    if by_itself := [stack.name for stack in record.stacks if stack.mask_from in ("automatic", "command")]:
        masks, were = ("mask", "was") if len(by_itself) == 1 else ("masks", "were")
        facts: dict[str, object] = {"masks": masks, "were": were, "stacks": _listed(by_itself)}
        yield "masks found", facts
    if whole := [stack.name for stack in record.stacks if stack.mask_from in ("whole image", "empty background")]:
        yield "whole image", {"stacks": _listed(whole)}
    if assumed := [stack for stack in record.stacks if stack.thickness_from == "spacing"]:
        mm = ", ".join(sorted({f"{stack.thickness_mm:g}" for stack in assumed}))
        yield "thickness assumed", {"stacks": _listed([stack.name for stack in assumed]), "mm": mm}
    if record.partial:
        name = "partial of a budget" if record.time_budget else "partial"
        yield name, {"where": str(record.stopped_at or "interrupted")}
    elif not record.settings.n_lattices:
        kind = "the prior volume" if record.settings.use_prior else "a least-squares volume of the slices"
        yield "not fitted" if record.time_budget else "preview", {"what": kind}
    elif record.prior_weight == 1 and not (record.volume_check and record.volume_check.falls_back):
        yield "fit ended early", {}
    elif not record.settings.use_prior and _hardly_begun(record):
        yield "fit hardly begun", {"steps": _n_steps(record)}
    search = record.settings.registration
    looked_for_sides = search.check_handedness or not (search.template or record.time_budget)
    # of one or two stacks nobody asks, however much time there is
    if record.settings.n_lattices and not looked_for_sides and len(record.stacks) > 2:
        yield "sides not compared", {}
    said = {unseen, checked}
    for line in record.warnings:
        if line not in said and not _is_said_otherwise(line, record):
            yield "warning", {"line": line}


def _used(record: RunRecord) -> list[StackRecord]:
    return [stack for stack in record.stacks if not (stack.quality and stack.quality.left_out)]


def _n_steps(record: RunRecord) -> int:
    return len(record.loss.get(Stage.FIT_TO_SLICES, []))


def _hardly_begun(record: RunRecord) -> bool:
    return ended_early(_n_steps(record), record.settings.slice_stage.n_steps)


def _of_stack(stack: StackRecord) -> Iterator[tuple[str, dict[str, object]]]:
    quality = stack.quality
    if quality and quality.left_out:
        yield "mirrored left out" if is_mirrored(quality) else "left out", {"stack": stack.name, "why": misfit(quality)}
        return
    for remark in stack.remarks:
        yield "file doubtful", {"stack": stack.name, "remark": remark}
    if stack.left_out_share:
        yield "mask too small", {"stack": stack.name, "share": f"{100 * stack.left_out_share:.0f} %"}
    if quality is None:
        return
    facts: dict[str, object] = {"stack": stack.name, "agreement": _agreement(stack)}
    if is_mirrored(quality):
        yield "stack mirrored", facts | {"handedness": rounded_down(quality.handedness), "good": MIRRORED_BELOW}
        if not shortfalls(quality):
            return
    if quality.reliable is False:
        why = "; ".join(shortfalls(quality))
        yield "stack not used" if quality.median_slice_ncc is None else "stack failed", facts | {"shortfalls": why}
    elif quality.held_out_correlation is not None and quality.held_out_correlation < RETRY_BELOW_CORRELATION:
        yield "stack doubtful", facts | {"good": RETRY_BELOW_CORRELATION}
    if quality.median_move_mm is not None and quality.median_move_mm > MAX_MEDIAN_MOVE_MM:
        yield "stack jumps", facts | {"mm": f"{quality.median_move_mm:.1f}", "good": MAX_MEDIAN_MOVE_MM}


def _unlike_others(record: RunRecord) -> Iterator[tuple[str, dict[str, object]]]:
    """Stacks that passed all tests of single stacks, but agree less with the volume than the best stack does."""
    found = [(stack.name, stack.quality) for stack in record.stacks if stack.quality]
    ncc = [0.0 if one.left_out else one.median_slice_ncc or 0.0 for _, one in found]
    for n in unlike_others([one for _, one in found]):
        yield "stack unlike others", {"stack": found[n][0], "ncc": f"{ncc[n]:.2f}", "best": f"{max(ncc):.2f}"}


def _agreement(stack: StackRecord) -> str:
    found = stack.quality.held_out_correlation if stack.quality else None
    return rounded_down(found)


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _is_said_otherwise(line: str, record: RunRecord) -> bool:
    """Whether a warning of the run has its own message in the table."""
    if line.startswith(LOSS_ROSE):
        return record.n_rollbacks > 0
    if line.startswith(PARALLEL):
        return True
    return any(line.startswith(f"{stack.name}: {start}") for stack in record.stacks for start in JUDGED)
