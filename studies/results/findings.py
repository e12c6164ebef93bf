"""What a claim is, and how one is decided: from figures of published tables, and never from fewer than are needed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import mean

from studies.results.blocks import Block, Table, TableRow, number

HOLDS, FAILS, UNSAID, MISSING = "holds", "does not hold", "cannot be said", "not measured"

NOTICEABLE_DB = 0.1
"""A part that brings less does not help."""

FEW = 4
"""Fewer subjects, or cases, say nothing in general."""

FEW_RUNS = 20
"""Fewer runs cannot show a share of 95 %."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What was measured about a claim.

    Attributes:
        figure: as text.
        n: how many were measured.
        of: what, such as "subjects".
        holds: whether the figure is as claimed.
        enough: whether so many can show it.
    """

    figure: str
    n: int
    of: str
    holds: bool
    enough: bool

    @property
    def outcome(self) -> str:
        """In two or three words."""
        if not self.enough:
            return UNSAID
        return HOLDS if self.holds else FAILS

    @property
    def counted(self) -> str:
        """How many were measured, in words: "1 subject", "3 subjects"."""
        return f"{self.n} {self.of.removesuffix('s') if self.n == 1 else self.of}"


@dataclass(frozen=True, kw_only=True)
class Claim:
    """Something that is said of g3r or in the paper.

    Attributes:
        text: the claim.
        asked: when it holds; and who asked for that, or what the paper says.
        block: the published block with the figure.
        find: the finding, from the block; None where the block has no such figure.
        yes, no: the conclusion if it holds and if it does not; "{figure}" becomes the figure.
    """

    text: str
    asked: str
    block: str
    find: Callable[[Block], Finding | None]
    yes: str
    no: str


@dataclass(frozen=True)
class Judged:
    """A claim with what was found.

    Attributes:
        claim: that was judged.
        finding: None where nothing was measured.
        older: its table is of other weights than those that are shipped.
    """

    claim: Claim
    finding: Finding | None
    older: bool = False

    @property
    def outcome(self) -> str:
        """In two or three words."""
        return self.finding.outcome if self.finding else MISSING

    @property
    def so_far(self) -> str:
        """What it looks like where there are too few; empty where there are enough, or none."""
        if self.finding is None or self.finding.enough:
            return ""
        return f"so far it {HOLDS if self.finding.holds else FAILS}"

    @property
    def verdict(self) -> str:
        """The outcome, and what it looks like so far."""
        return f"{self.outcome} (n too small; {self.so_far})" if self.so_far else self.outcome

    @property
    def conclusion(self) -> str:
        """In plain words."""
        if self.finding is None:
            return f"{self.claim.text}."
        if self.finding.enough:
            text = self.claim.yes if self.finding.holds else self.claim.no
            said = text.format(figure=self.finding.figure)
        else:
            said = f"{self.claim.text} ({self.finding.figure}; {self.finding.counted})."
        return f"{said} With older weights." if self.older else said


def judged(claim: Claim, blocks: Mapping[str, Block], shipped: str) -> Judged:
    """A claim decided by what is published.

    Args:
        claim: to decide.
        blocks: all that is published.
        shipped: the weights of the prior.
    """
    block = blocks.get(claim.block)
    if block is None or not block.is_measured:
        return Judged(claim, None)
    return Judged(claim, claim.find(block), block.is_older(shipped))


def shares(hits: int, n: int, at_least: float, of: str) -> Finding:
    """A share of runs; few runs can show that it is missed, and not that it is reached.

    Args:
        hits: how many were as wanted.
        n: how many there were.
        at_least: share that is asked for.
        of: what was counted.
    """
    # missed for good, if it would be even had all further ones been right
    missed = n - hits > (1 - at_least) * max(n, FEW_RUNS)
    return Finding(
        figure=f"{hits} of {n}" + (f", {100 * hits / n:.0f} %" if n else ""),
        n=n,
        of=of,
        holds=n > 0 and hits / n >= at_least,
        enough=n >= FEW_RUNS or missed,
    )


def paired(values: Sequence[tuple[float, float]], at_least: float, needed: int, of: str = "subjects") -> Finding | None:
    """The mean of differences in dB, first less second, with the least of them.

    Args:
        values: pairs, one for each subject.
        at_least: what the mean is to reach.
        needed: how many there must be.
        of: what was counted.
    """
    gains = [one - other for one, other in values]
    if not gains:
        return None
    return Finding(
        figure=f"{mean(gains):+.2f} dB, least {min(gains):+.2f}",
        n=len(gains),
        of=of,
        holds=mean(gains) >= at_least,
        enough=len(gains) >= needed,
    )


def value(row: TableRow | None, head: str) -> float | None:
    """The number in a cell; None without row, column or number."""
    return number(row.get(head, "")) if row else None


def column(rows: Iterable[TableRow], head: str) -> list[float]:
    """The numbers of a column."""
    return [found for row in rows if (found := value(row, head)) is not None]


def table_after(block: Block, words: str) -> Table | None:
    """The first table with these words right above it."""
    return next((table for table in block.tables if words in table.before), None)
