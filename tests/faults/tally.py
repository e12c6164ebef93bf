"""Cases tried, survived, refused and lost; `conftest.py` says how tests count them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class Counts:
    """Cases of one kind."""

    tried: int = 0
    survived: int = 0
    refused: int = 0

    @property
    def lost(self) -> int:
        """Neither survived nor refused."""
        return self.tried - self.survived - self.refused


@dataclass
class Case:
    """One case that is being tried."""

    was_refused: bool = False

    def refused(self) -> None:
        """Say that the input was refused, as it should be."""
        self.was_refused = True


@dataclass
class Tally:
    """Counts of one row of the table."""

    name: str
    rows: dict[str, Counts] = field(default_factory=dict)

    def named(self, name: str) -> Tally:
        """The same table, another row."""
        return Tally(name, self.rows)

    def add(self, tried: int, survived: int = 0, refused: int = 0) -> None:
        """Count many cases at once; what neither survived nor was refused is lost."""
        row = self.rows.setdefault(self.name, Counts())
        row.tried += tried
        row.survived += survived
        row.refused += refused

    @contextmanager
    def case(self) -> Iterator[Case]:
        """Count one case; an error inside makes it a lost one, and goes on."""
        case = Case()
        try:
            yield case
        except BaseException:
            self.add(1)
            raise
        self.add(1, survived=not case.was_refused, refused=case.was_refused)


def table(rows: dict[str, Counts]) -> list[str]:
    """The counts as lines of text, with a sum."""
    total = Counts(*(sum(getattr(row, name) for row in rows.values()) for name in ("tried", "survived", "refused")))
    width = max(len(name) for name in [*rows, "all"])
    lines = [f"{'':<{width}} {'tried':>7} {'survived':>9} {'refused':>8} {'lost':>5}"]
    lines += [
        f"{name:<{width}} {row.tried:>7} {row.survived:>9} {row.refused:>8} {row.lost:>5}"
        for name, row in [*sorted(rows.items()), ("all", total)]
    ]
    return lines
