"""`make results`: generates docs/results.md from the blocks that studies published in the other pages.

`python -m studies.results.page` is the same command.
"""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from g3r.bench.record import put_between_markers
from studies.harness import DOCS, weights
from studies.results import further_claims, paper_claims, picture_claims
from studies.results.blocks import PAGE, Block, origin, published
from studies.results.findings import FAILS, HOLDS, MISSING, UNSAID, Claim, Judged, judged
from studies.tables import table

MARKER = "results"
WIDTH = 118

TOPICS: Mapping[str, Callable[[], Iterable[Claim]]] = {
    "The paper's Table 1, three stacks": paper_claims.table_1,
    "The same in mild motion": paper_claims.mild_motion,
    "One stack": paper_claims.one_stack,
    "Parts of the fit": paper_claims.parts,
    "The prior": further_claims.prior,
    "Lesions": picture_claims.lesions,
    "Real stacks": paper_claims.real,
    "The verdict": further_claims.verdicts,
    "Speed against accuracy": further_claims.presets,
    "Masks": picture_claims.masks,
    "What no slice saw": picture_claims.unseen,
    "Another program": picture_claims.nesvor,
}

SO_FAR = f"so far it {HOLDS}", f"so far it {FAILS}"

CONCLUSIONS = (
    ("What holds", HOLDS, ""),
    ("What does not hold", FAILS, ""),
    ("Too few to say, but so far it holds", UNSAID, SO_FAR[0]),
    ("Too few to say, and so far it does not hold", UNSAID, SO_FAR[1]),
    ("Not measured yet", MISSING, ""),
)
"""Headings, each with an outcome and a preliminary outcome."""

PICTURES = {
    "paper-methods": (("paper-methods.png", "slices of one phantom by every method, with maps of the error"),),
    "paper-methods-atlas": (("paper-methods-atlas.png", "slices of one atlas volume by every method"),),
    "paper-variants-atlas": (("paper-stacks-atlas.png", "PSNR of the fit and its parts by number of stacks"),),
    "presets": (("presets.png", "PSNR against CPU seconds, a curve for each subject"),),
}
"""Pictures with captions, by the block that they illustrate."""


def judgements(blocks: Mapping[str, Block]) -> dict[str, list[Judged]]:
    """All decided claims, by topic."""
    shipped = weights(None)
    return {topic: [judged(claim, blocks, shipped) for claim in claims()] for topic, claims in TOPICS.items()}


def page(blocks: Mapping[str, Block]) -> str:
    """The text between the markers of docs/results.md."""
    found = judgements(blocks)
    parts = [
        "## In plain words",
        *conclusions([one for several in found.values() for one in several]),
        "## Claim by claim",
        *claims_tables(found, blocks),
        "## The main tables",
        *main_tables(blocks),
        "## Every published table",
        *sources(blocks),
    ]
    return "\n\n".join(parts)


def conclusions(found: Sequence[Judged]) -> Iterator[str]:
    """A sentence per claim, grouped by outcome."""
    number = {outcome: sum(one.outcome == outcome for one in found) for outcome in (HOLDS, FAILS, UNSAID, MISSING)}
    yield _wrapped(
        f"Of {len(found)} claims {number[HOLDS]} hold, {number[FAILS]} do not hold, {number[UNSAID]} cannot be decided "
        f"by so few subjects, and {number[MISSING]} are not measured."
    )
    for title, outcome, so_far in CONCLUSIONS:
        lines = [_item(one.conclusion) for one in found if (one.outcome, one.so_far) == (outcome, so_far)]
        if lines:
            yield f"### {title}"
            yield "\n".join(lines)


def claims_tables(found: Mapping[str, Sequence[Judged]], blocks: Mapping[str, Block]) -> Iterator[str]:
    """Tables of claims with figure, outcome and source."""
    for topic, several in found.items():
        yield f"### {topic}"
        rows = [
            {
                "claim": one.claim.text,
                "asked": one.claim.asked,
                "figure": one.finding.figure if one.finding else "-",
                "n": one.finding.counted if one.finding else "-",
                "outcome": one.verdict if one.outcome != HOLDS else f"**{one.verdict}**",
                "where": _where(one.claim.block, blocks) + ", older weights" * one.older,
            }
            for one in several
        ]
        columns = {"claim": "{claim}", "it holds if": "{asked}", "measured": "{figure}"}
        yield _left(table(rows, {**columns, "of": "{n}", "outcome": "{outcome}", "where": "{where}"}))


def main_tables(blocks: Mapping[str, Block]) -> Iterator[str]:
    """Table 1 in the mask, the verdicts, the presets and real stacks, as they are published, with their pictures."""
    for name, title in (
        ("paper-methods", "Phantoms, by every method, in the mask"),
        ("paper-methods-atlas", "Atlas volumes, by every method, in the mask"),
        ("paper-variants", "The fit without its parts, phantoms"),
        ("paper-variants-atlas", "The fit without its parts, atlas volumes"),
        ("paper-real", "Real stacks, held out and predicted"),
        ("stress-sweep", "One thing wrong at a time, and the verdict"),
        ("presets", "Presets"),
    ):
        block = blocks.get(name)
        if block is None or not block.is_measured:
            continue
        yield f"### {title}"
        yield f"Copied from [{block.page}]({block.page})."
        shown = [one for one in block.tables if "**" in one.before and "stack" in one.before] or block.tables[:1]
        for one in shown:
            yield from (part for part in (_lead(one.before), one.text) if part)
        yield from (f"![{words}](images/{file})" for file, words in PICTURES.get(name, ()))


def sources(blocks: Mapping[str, Block]) -> Iterator[str]:
    """Machine, commit and weights that each table states."""
    shipped = weights(None)
    yield _wrapped(
        f"The shipped weights of the prior are {shipped}. *Older weights* marks tables of others. A commit with a + "
        "had changes that were not committed. `git log COMMIT..` says what has changed since."
    )
    rows = []
    for name, block in blocks.items():
        of = origin(name, blocks)
        rows.append(
            {
                "name": name,
                "page": f"[{block.page}]({block.page})",
                "command": f"`{block.command}`" if block.command else "-",
                "machine": of.machine or "not stated",
                "commit": of.commit or "not stated",
                "note": ("older weights" * block.is_older(shipped)) if block.is_measured else "not measured",
            }
        )
    heads = ("name", "page", "command", "machine", "commit", "note")
    yield _left(table(rows, {("table" if head == "name" else head): f"{{{head}}}" for head in heads}))


def _lead(before: str) -> str:
    """Text above a table, without the markup that collapses it and without other tables."""
    lines = [line for line in before.splitlines() if line.strip() and not line.startswith("</details>")]
    return "\n\n".join(lines)


def _where(name: str, blocks: Mapping[str, Block]) -> str:
    block = blocks.get(name)
    if block is None:
        return "-"
    command = " ".join(block.command.split()[:2])
    return f"[{block.page}]({block.page})" + (f", `{command}`" if command else "")


def _wrapped(text: str) -> str:
    return textwrap.fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)


def _item(text: str) -> str:
    return textwrap.fill(f"- {text}", WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def _left(text: str) -> str:
    """The table with all columns left-aligned."""
    return text.replace("---:", "---")


def main(argv: Sequence[str] | None = None) -> int:
    """Rewrite docs/results.md; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.results.page", description="Rewrite docs/results.md from the tables of the other pages."
    )
    parser.add_argument("--docs", type=Path, default=DOCS, metavar="DIR", help="the pages (default: docs/)")
    options = parser.parse_args(argv)
    put_between_markers(options.docs / PAGE, MARKER, page(published(options.docs)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
