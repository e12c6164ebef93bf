"""Memory as g3r-infer states it against what its process held, and runs below limits, on phantoms."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from g3r.bench.command_run import infer_arguments, run_infer
from g3r.bench.record import machine, machine_line, markdown_table, put_between_markers, write_json
from g3r.evaluation.case import SimulatedCase, load_case
from studies.command import run_command
from studies.tradeoff.memory_limits import is_kept, limited_rows, limits_table

REPOSITORY = Path(__file__).resolve().parents[2]

FIRST_SEED = 61200


@dataclass(frozen=True)
class Configuration:
    """A phantom, how it is scanned, and what is asked for."""

    weeks: int
    n_stacks: int
    preset: str
    voxel_mm: float
    threads: int = 1
    more: tuple[str, ...] = ()


CONFIGURATIONS = (
    Configuration(22, 1, "draft", 1.2),
    Configuration(22, 3, "draft", 0.5),
    Configuration(22, 6, "fast", 0.8),
    Configuration(30, 1, "draft", 0.5),
    Configuration(30, 3, "draft", 0.8, 2),
    Configuration(30, 3, "balanced", 0.8),
    Configuration(30, 6, "draft", 1.2),
    Configuration(37, 1, "draft", 0.8),
    Configuration(37, 3, "draft", 1.2, 1, ("--no-prior",)),
    Configuration(37, 3, "draft", 0.5, 2),
)
"""Small and large heads, few and many stacks, coarse and fine voxels; draft where nothing else is asked."""

LIMITED = (Configuration(30, 3, "draft", 0.8), Configuration(30, 1, "draft", 0.5))
"""Run below limits: the usual case, whose prior network needs most, and one of many voxels."""


def phantom(weeks: int, n_stacks: int, folder: Path) -> SimulatedCase:
    """A simulated subject, made if it is not there."""
    from data_synth import cli as simulate

    where = folder / f"phantom-{weeks}-{n_stacks}"
    if not (where / "simulation.json").is_file():
        arguments = ["--phantom", str(weeks), "--stacks", str(n_stacks), "--seed", str(FIRST_SEED + weeks)]
        simulate.main([*arguments, "--output", str(where), "--force"])
    return load_case(where)


def arguments_for(one: Configuration, case: SimulatedCase, output: Path) -> list[str]:
    """Of g3r-infer."""
    return [
        *infer_arguments(case, one.preset, output),
        "--threads",
        str(one.threads),
        "--resolution",
        f"{one.voxel_mm:g}",
        *one.more,
    ]


def measured(one: Configuration, folder: Path) -> dict[str, Any]:
    """Stated and measured bytes of one run of the command."""
    case = phantom(one.weeks, one.n_stacks, folder)
    run = run_infer(arguments_for(one, case, folder / "out"), folder / "out")
    said = run.record.memory
    assert said is not None
    return {
        "weeks": one.weeks,
        "stacks": one.n_stacks,
        "preset": one.preset,
        "voxel_mm": one.voxel_mm,
        "threads": one.threads,
        "more": " ".join(one.more),
        "stated_bytes": said.stated_bytes,
        "stage": said.stage,
        "measured_bytes": run.peak_bytes,
    }


def table(record: dict[str, Any]) -> str:
    """The record in Markdown."""
    head = ("phantom", "stacks", "preset", "voxel", "threads", "stated", "most of it in", "measured", "ratio")
    rows = [
        (
            f"{row['weeks']} weeks",
            row["stacks"],
            f"{row['preset']} {row['more']}".strip(),
            f"{row['voxel_mm']:g} mm",
            row["threads"],
            f"{row['stated_bytes'] / 1e9:.2f} GB",
            row["stage"],
            f"{row['measured_bytes'] / 1e9:.2f} GB",
            f"{row['stated_bytes'] / row['measured_bytes']:.2f}",
        )
        for row in record["rows"]
    ]
    return f"{markdown_table(head, rows)}\n\n{machine_line(record['machine'])}"


def run(options: argparse.Namespace) -> int:
    """Measure, print the tables; 1 if a statement, or a limit, is below what was held, or stated too much."""
    path = options.output / "memory.json"
    record: dict[str, Any] = {"machine": machine(2), "rows": [], "limited": []}
    if options.part != "all" and path.is_file():  # the other part as it was measured before
        record = json.loads(path.read_text(encoding="utf-8")) | {"machine": machine(2)}
    if options.part != "limits":
        record["rows"] = []
        for one in CONFIGURATIONS:
            print(f"memory: {one}", file=sys.stderr, flush=True)
            record["rows"].append(measured(one, options.output))
            write_json(path, record)
    if options.part != "statement":
        record["limited"] = []
        for one in LIMITED:
            print(f"memory: {one}, limited", file=sys.stderr, flush=True)
            case, output = phantom(one.weeks, one.n_stacks, options.output), options.output / "out"
            name = f"{one.weeks} weeks, {one.n_stacks} stacks, {one.preset}, {one.voxel_mm:g} mm"
            record["limited"] += limited_rows(case, name, arguments_for(one, case, output), output)
            write_json(path, record)
    for name, text in (("memory", table(record)), ("memory-limits", limits_table(record["limited"]))):
        print(f"{text}\n")
        if options.docs:
            put_between_markers(options.docs, name, text)
    ratios = [row["stated_bytes"] / row["measured_bytes"] for row in record["rows"]] or [1.0]
    good = min(ratios) >= 1 and max(ratios) <= options.most and all(map(is_kept, record["limited"]))
    return 0 if good else 1


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `python -m studies.tradeoff.memory`."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.tradeoff.memory",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--output", type=Path, default=REPOSITORY / "runs" / "memory", help="for the record")
    parser.add_argument("--docs", type=Path, metavar="FILE", help="also put the table between its markers")
    parser.add_argument("--part", choices=("all", "statement", "limits"), default="all", help="of the tables")
    parser.add_argument("--most", type=float, default=1.5, help="largest ratio of stated to measured")
    return run_command("memory", run, parser.parse_args(argv))


if __name__ == "__main__":
    raise SystemExit(main())
