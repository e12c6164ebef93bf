"""`python -m studies.tradeoff.memory`: memory stated by g3r-infer against the memory of its process, on phantoms."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from g3r.bench.command_run import infer_arguments, run_infer
from g3r.bench.record import machine_line
from g3r.bench.scores import quality_of_folder
from g3r.errors import InputError
from g3r.evaluation.case import SimulatedCase, load_case
from studies.harness import Record, Row, Study, Task
from studies.tables import table

FIRST_SEED = 61200


@dataclass(frozen=True, kw_only=True)
class Configuration:
    """A phantom, its stacks, and the options of the run; a row of the table."""

    weeks: int
    n_stacks: int
    preset: str
    voxel_mm: float
    threads: int = 1
    more: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The configuration in words."""
        words = f"{self.weeks} weeks, {self.n_stacks} stacks, {self.preset}, {self.voxel_mm:g} mm"
        return f"{words}, {self.threads} threads {' '.join(self.more)}".strip()


CONFIGURATIONS = (
    Configuration(weeks=22, n_stacks=1, preset="fast", voxel_mm=1.2),
    Configuration(weeks=22, n_stacks=3, preset="fast", voxel_mm=0.5),
    Configuration(weeks=22, n_stacks=6, preset="fast", voxel_mm=0.8),
    Configuration(weeks=30, n_stacks=1, preset="fast", voxel_mm=0.5),
    Configuration(weeks=30, n_stacks=3, preset="preview", voxel_mm=0.8, threads=2),
    Configuration(weeks=30, n_stacks=3, preset="balanced", voxel_mm=0.8),
    Configuration(weeks=30, n_stacks=3, preset="accurate", voxel_mm=0.8, threads=2),
    Configuration(weeks=30, n_stacks=6, preset="fast", voxel_mm=1.2),
    Configuration(weeks=37, n_stacks=1, preset="fast", voxel_mm=0.8),
    Configuration(weeks=37, n_stacks=3, preset="preview", voxel_mm=0.5),
    Configuration(weeks=37, n_stacks=3, preset="fast", voxel_mm=1.2, more=("--no-prior",)),
    Configuration(weeks=37, n_stacks=3, preset="fast", voxel_mm=0.5, threads=2),
)
"""Small and large heads, few and many stacks, coarse and fine voxels; mostly with `fast`, which has all parts that need
memory."""

LIMITED = (
    Configuration(weeks=30, n_stacks=3, preset="fast", voxel_mm=0.8),
    Configuration(weeks=30, n_stacks=1, preset="fast", voxel_mm=0.5),
)
"""Configurations that are run with memory limits: the usual case, where the prior network needs most memory, and a case
with many voxels."""


SHARES = (1.0, 0.9, 0.8, 0.7)
"""Memory limits, as shares of the memory stated without a limit."""

GB = 1e9


def _phantom(weeks: int, n_stacks: int, folder: Path) -> SimulatedCase:
    """A simulated subject, made if it does not exist."""
    from data_synth import cli as simulate

    where = folder / f"phantom-{weeks}-{n_stacks}"
    if not (where / "simulation.json").is_file():
        arguments = ["--phantom", str(weeks), "--stacks", str(n_stacks), "--seed", str(FIRST_SEED + weeks)]
        simulate.main([*arguments, "--output", str(where), "--force"])
    return load_case(where)


def _arguments_for(one: Configuration, case: SimulatedCase, output: Path) -> list[str]:
    """Arguments of g3r-infer."""
    return [
        *infer_arguments(case, one.preset, output),
        "--threads",
        str(one.threads),
        "--resolution",
        f"{one.voxel_mm:g}",
        *one.more,
    ]


def stated(one: Configuration, folder: Path) -> Row:
    """Stated and measured bytes of one run of the command."""
    case = _phantom(one.weeks, one.n_stacks, folder)
    run = run_infer(_arguments_for(one, case, folder / "out"), folder / "out")
    memory = run.record.memory
    assert memory is not None
    return {
        "weeks": one.weeks,
        "stacks": one.n_stacks,
        "preset": one.preset,
        "voxel_mm": one.voxel_mm,
        "threads": one.threads,
        "more": " ".join(one.more),
        "stated_bytes": memory.stated_bytes,
        "stage": memory.stage,
        "measured_bytes": run.peak_bytes,
    }


def limited(one: Configuration, folder: Path) -> Row:
    """Runs of the command without a limit and with several limits."""
    case, output = _phantom(one.weeks, one.n_stacks, folder), folder / "out"
    name = f"{one.weeks} weeks, {one.n_stacks} stacks, {one.preset}, {one.voxel_mm:g} mm"
    return {"limited": _limited_rows(case, name, _arguments_for(one, case, output), output)}


def _limited_rows(case: SimulatedCase, name: str, arguments: Sequence[str], output: Path) -> list[Row]:
    """A row without a limit, and one for each limit."""
    first = _row(case, name, arguments, output, None)
    limits = [round(share * first["stated_bytes"]) for share in SHARES]
    return [first, *[_row(case, name, arguments, output, limit) for limit in limits]]


def _row(case: SimulatedCase, name: str, arguments: Sequence[str], output: Path, limit: int | None) -> Row:
    row: Row = {"name": name, "limit_bytes": limit}
    try:
        run = run_infer([*arguments, *([] if limit is None else ["--max-memory", str(limit)])], output)
    except InputError as error:
        return row | {"refused": str(error)}
    memory = run.record.memory
    assert memory is not None
    return row | {
        "stated_bytes": memory.stated_bytes,
        "measured_bytes": run.peak_bytes,
        "changes": memory.changes,
        "seconds": round(run.seconds, 1),
        "cpu_seconds": round(run.cpu_seconds, 1),
        "psnr_db": quality_of_folder(case, output).psnr_db,
    }


def is_kept(row: Row) -> bool:
    """Whether a run stayed below its limit, or was refused."""
    limit = row["limit_bytes"]
    return limit is None or "refused" in row or row["measured_bytes"] <= limit


def limits_table(rows: Sequence[Row]) -> str:
    """Markdown table of the runs with limits."""

    def given_up(row: Row) -> str:
        if "refused" in row:
            return str(row["refused"]).split(";")[0]
        return "; ".join(change.removeprefix("memory limit: ") for change in row["changes"]) or "nothing"

    def gigabytes(row: Row, key: str, otherwise: str) -> str:
        return f"{row[key] / GB:.2f} GB" if row.get(key) is not None else otherwise

    columns: dict[str, Any] = {
        "run": "{name}",
        "limit": lambda row: gigabytes(row, "limit_bytes", "none"),
        "stated": lambda row: gigabytes(row, "stated_bytes", "refused"),
        "measured": lambda row: gigabytes(row, "measured_bytes", ""),
        "CPU seconds": "{cpu_seconds:.0f}",
        "PSNR, dB": "{psnr_db:.2f}",
        "given up": given_up,
    }
    return table(rows, columns)


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """Tasks for the configurations without limits, and for those with limits."""
    if options.part != "limits":
        yield from (Task(one.name, stated, (one, options.output)) for one in CONFIGURATIONS)
    if options.part != "statement":
        yield from (Task(f"{one.name}, limited", limited, (one, options.output)) for one in LIMITED)


def parts(record: Record) -> tuple[list[Row], list[Row]]:
    """Rows of the runs without limits, and rows of the runs with limits."""
    rows = record["rows"].values()
    return [row for row in rows if "limited" not in row], [one for row in rows for one in row.get("limited", [])]


def tables(record: Record) -> dict[str, str]:
    """Table of stated against measured memory, and table of runs with limits; each only if measured."""
    columns: dict[str, Any] = {
        "phantom": "{weeks} weeks",
        "stacks": "{stacks}",
        "preset": lambda row: f"{row['preset']} {row['more']}".strip(),
        "voxel": "{voxel_mm:g} mm",
        "threads": "{threads}",
        "stated": lambda row: f"{row['stated_bytes'] / 1e9:.2f} GB",
        "most of it in": "{stage}",
        "measured": lambda row: f"{row['measured_bytes'] / 1e9:.2f} GB",
        "ratio": lambda row: f"{row['stated_bytes'] / row['measured_bytes']:.2f}",
    }
    statements, limits = parts(record)
    texts = {"memory": f"{table(statements, columns)}\n\n{machine_line(record['machine'])}"} if statements else {}
    return texts | ({"memory-limits": limits_table(limits)} if limits else {})


def keeps_its_word(record: Record) -> bool:
    """Whether measured memory exceeds neither a statement nor a limit, and no statement is too high."""
    statements, limits = parts(record)
    ratios = [row["stated_bytes"] / row["measured_bytes"] for row in statements] or [1.0]
    return min(ratios) >= 1 and max(ratios) <= record["most"] and all(map(is_kept, limits))


STUDY = Study(
    name="tradeoff.memory",
    about="Memory as g3r-infer states it against what its process held, and runs below limits, on phantoms. "
    "Ends with 1 where a statement, or a limit, is below what was held, or too much is stated.",
    document="tradeoff.md",
    shared=(),
    options={
        "--part": {"choices": ("all", "statement", "limits"), "default": "all", "help": "of the tables"},
        "--most": {"type": float, "default": 1.5, "help": "largest ratio of stated to measured"},
    },
    settings=lambda options: {"most": options.most},
    tasks=tasks,
    tables=tables,
    verdict=keeps_its_word,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
