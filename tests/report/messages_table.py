"""Table of all verdict messages in docs/report.md: `python -m tests.report.messages_table` writes it."""

from __future__ import annotations

from g3r.bench.record import markdown_table, put_between_markers
from g3r.registration.thresholds import MAX_MEDIAN_MOVE_MM, MIN_CROSSING_DEG, MIRRORED_BELOW, RETRY_BELOW_CORRELATION
from g3r.report.verdict_messages import CHECK, DO_NOT_USE, MESSAGES, USE
from g3r.uncertainty.unseen import DO_NOT_USE_ABOVE, MENTIONED_ABOVE
from tests.rooms import REPOSITORY

DOCUMENT = REPOSITORY / "docs" / "report.md"
MARKER = "messages"

FILLED_IN = {
    "stack": "NAME",
    "stacks": "NAME",
    "agreement": "N",
    "masks": "mask",
    "were": "was",
    "mm": "N",
    "n": "N",
    "all": "N",
    "where": "interrupted",
    "steps": "N",
    "share": "N %",
    "ncc": "N",
    "best": "N",
    "rival": "N",
    "what": "brain",
    "handedness": "N",
    "angle": "N",
    "remark": "what is doubtful in its header, mask or thickness",
    "shortfalls": "what is bad of it, and what is good",
}

GOOD = {"stack mirrored": MIRRORED_BELOW, "stack jumps": MAX_MEDIAN_MOVE_MM, "stacks parallel": MIN_CROSSING_DEG}
"""Limits of messages; the others use the limit of the agreement."""

LINES = {
    "unseen too much": f"N % of the brain was not seen by any slice (N ml) ..., above {100 * DO_NOT_USE_ABOVE:.0f} %; "
    "or: the field of view cuts the head: about N % of the brain lies beyond ...",
    "unseen": f"N % of the brain was not seen by any slice (N ml): it is shown as an estimate from other brains; from "
    f"{100 * MENTIONED_ABOVE:g} % on",
    "volume check": "the fit made the volume worse ..., or: the mean of the slices explains them better ...",
    "mirrored left out": "it is probably a mirror image of what the other stacks show (handedness N)",
    "left out": "it does not fit the other stacks (what is bad of it, and what is good)",
    "warning": "any other warning of the run, as `run.json` has it",
}
"""Texts of messages that are made elsewhere."""


def table() -> str:
    """The table: a row for each message, the worst first."""
    rows = []
    for word in (DO_NOT_USE, CHECK, USE):
        for name, message in MESSAGES.items():
            if message.word == word:
                facts = FILLED_IN | {
                    "good": GOOD.get(name, RETRY_BELOW_CORRELATION),
                    "line": (line := LINES.get(name, "")),
                    "why": line,
                }
                rows.append([word, message.text.format(**facts), message.advice])
    return markdown_table(["verdict", "what it says", "what it advises"], rows).replace("---:", "---")


if __name__ == "__main__":
    put_between_markers(DOCUMENT, MARKER, table())
