"""Claims and their decision: from figures of published tables, and only if enough subjects were measured."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import mean

from studies.results.blocks import Block, Table, TableRow, number

HOLDS, FAILS, UNSAID, MISSING = "holds", "does not hold", "cannot be said", "not measured"

NOTICEABLE_DB = 0.1
"""Least gain that counts; a part with less does not help."""

FEW = 4
"""Least number of subjects or cases for a general statement."""

FEW_RUNS = 20
"""Least number of runs that can show a share of 95 %."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Measurement that decides a claim.

    Attributes:
        figure: as text.
        n: number of measurements.
        of: measured things, such as "subjects".
        holds: whether the figure is as claimed.
        enough: whether `n` is enough to decide the claim.
    """

    figure: str
    n: int
    of: str
    holds: bool
    enough: bool

    @property
    def outcome(self) -> str:
        """Outcome in two or three words."""
        if not self.enough:
            return UNSAID
        return HOLDS if self.holds else FAILS

    @property
    def counted(self) -> str:
        """Number of measurements in words: "1 subject", "3 subjects"."""
        return f"{self.n} {self.of.removesuffix('s') if self.n == 1 else self.of}"


@dataclass(frozen=True, kw_only=True)
class Claim:
    """A claim about g3r or in the paper.

    Attributes:
        text: the claim.
        asked: criterion by which it holds, with its source or the paper's figure.
        block: the published block with the figure.
        find: function that returns the finding from the block; None if the block has no such figure.
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
    """A claim with its finding.

    Attributes:
        claim: that was judged.
        finding: None if nothing was measured.
        older: whether its table was measured with weights other than the shipped ones.
    """

    claim: Claim
    finding: Finding | None
    older: bool = False

    @property
    def outcome(self) -> str:
        """Outcome in two or three words."""
        return self.finding.outcome if self.finding else MISSING

    @property
    def so_far(self) -> str:
        """Preliminary outcome if there are too few measurements; empty if there are enough or none."""
        if self.finding is None or self.finding.enough:
            return ""
        return f"so far it {HOLDS if self.finding.holds else FAILS}"

    @property
    def verdict(self) -> str:
        """The outcome, with the preliminary one if there is one."""
        return f"{self.outcome} (n too small; {self.so_far})" if self.so_far else self.outcome

    @property
    def conclusion(self) -> str:
        """Conclusion in plain words."""
        if self.finding is None:
            return f"{self.claim.text}."
        if self.finding.enough:
            text = self.claim.yes if self.finding.holds else self.claim.no
            said = text.format(figure=self.finding.figure)
        else:
            said = f"{self.claim.text} ({self.finding.figure}; {self.finding.counted})."
        return f"{said} With older weights." if self.older else said


def judged(claim: Claim, blocks: Mapping[str, Block], shipped: str) -> Judged:
    """A claim decided from the published blocks.

    Args:
        claim: to decide.
        blocks: all published blocks.
        shipped: the shipped weights of the prior.
    """
    block = blocks.get(claim.block)
    if block is None or not block.is_measured:
        return Judged(claim, None)
    return Judged(claim, claim.find(block), block.is_older(shipped))


def shares(hits: int, n: int, at_least: float, of: str) -> Finding:
    """Finding about a share of runs; few runs can show that it is missed, but not that it is reached.

    Args:
        hits: number of runs as wanted.
        n: number of runs.
        at_least: required share.
        of: counted things, such as "runs".
    """
    # certainly missed if it would be missed even with all further runs right
    missed = n - hits > (1 - at_least) * max(n, FEW_RUNS)
    return Finding(
        figure=f"{hits} of {n}" + (f", {100 * hits / n:.0f} %" if n else ""),
        n=n,
        of=of,
        holds=n > 0 and hits / n >= at_least,
        enough=n >= FEW_RUNS or missed,
    )


def paired(values: Sequence[tuple[float, float]], at_least: float, needed: int, of: str = "subjects") -> Finding | None:
    """Finding about the mean of paired differences in dB, first minus second, with the smallest difference.

    Args:
        values: pairs, one for each subject.
        at_least: required mean.
        needed: least number of pairs.
        of: counted things, such as "subjects".
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
    """The number in a cell; None if row, column or number is missing."""
    return number(row.get(head, "")) if row else None


def column(rows: Iterable[TableRow], head: str) -> list[float]:
    """The numbers of a column."""
    return [found for row in rows if (found := value(row, head)) is not None]


def table_after(block: Block, words: str) -> Table | None:
    """The first table directly below the given words."""
    return next((table for table in block.tables if words in table.before), None)
