"""`python -m studies.tradeoff.presets`: every preset on subjects that no setting was chosen on."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from statistics import mean
from typing import Any

from g3r.planning.presets import PRESETS
from g3r.reconstruct import GaussianReconstructor
from studies.harness import Record, Row, Study, Task
from studies.runs import aligned, figures
from studies.subjects import SizedSubject, is_named, simulated_case
from studies.tables import Cell, table
from studies.tradeoff.presets_figure import draw_presets

FIRST_SEED = 64_000

HEADS = ("crl-sta/sta24", "crl-sta/sta34", "spina-bifida/sb33-operated", "spina-bifida/sb34-operated")
"""Heads that no network was trained on. Weeks next to those of the `sta` heads are in the training data. What was
looked at when settings were chosen is in docs/tradeoff.md."""

SIZES = ((0.7, 3.0, 0.0), (1.0, 2.5, 0.0), (1.1, 3.0, 0.3), (1.3, 4.0, 0.0))
"""Pixel size, slice thickness and gap in mm."""

MOTIONS = ("moderate", "mild")


def _subject(head: int, motion: int) -> SizedSubject:
    pixel_mm, thickness_mm, gap_mm = SIZES[(head + 2 * motion) % len(SIZES)]
    return SizedSubject(
        volume=HEADS[head],
        motion=MOTIONS[motion],
        seed=FIRST_SEED + 10 * motion + head,
        pixel_mm=pixel_mm,
        thickness_mm=thickness_mm,
        gap_mm=gap_mm,
    )


SUBJECTS = tuple(_subject(head, motion) for motion in range(len(MOTIONS)) for head in range(len(HEADS)))

TRADE = ("preview", "fast", "balanced", "accurate")

FEWER_STACKS = "balanced"
"""Preset in which two stacks and one are measured; two stacks are also measured with `accurate`."""


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """The tasks of `all_tasks` whose key has a part that matches --cases."""
    for task in all_tasks(options):
        if is_named(task.key, options.cases):
            yield task


def all_tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per reconstruction, quick presets of all subjects first."""
    quick, careful = TRADE[:-1], TRADE[-1]
    wanted = (*((preset, 3) for preset in quick), (FEWER_STACKS, 2), (careful, 3), (FEWER_STACKS, 1), (careful, 2))
    for preset, n_stacks in wanted:
        for spec in SUBJECTS:
            yield Task(f"{spec.name}, {n_stacks}, {preset}", measure, (spec, n_stacks, preset, options))


def measure(spec: SizedSubject, n_stacks: int, preset: str, options: argparse.Namespace) -> Row:
    """Reconstruct one subject from its first stacks.

    Args:
        spec: the subject.
        n_stacks: number of its first stacks to use.
        preset: settings.
        options: of the command.
    """
    case = simulated_case(spec, options.cache, n_stacks)
    start = time.perf_counter(), time.process_time()
    result = GaussianReconstructor(options.ckpt, PRESETS[preset]).reconstruct(case.stacks)
    seconds, cpu_seconds = time.perf_counter() - start[0], time.process_time() - start[1]
    error = case.pose_error(result.slices)
    volumes = {
        "volume": (result.volume, result.grid),
        "V_prior": (result.prior, result.prior_grid),
        "V_coarse": (result.coarse, result.prior_grid),
    }
    return {
        "subject": spec.name,
        "pixel_mm": spec.pixel_mm,
        "thickness_mm": spec.thickness_mm,
        "n_stacks": n_stacks,
        "preset": preset,
        "seconds": round(seconds, 1),
        "cpu_seconds": round(cpu_seconds, 1),
        "tre_mm": round(error.median_mm, 3),
        "scores": {name: figures(aligned(case, *both, error.common).scores) for name, both in volumes.items()},
        "pose_rounds": result.record.pose_rounds.n_kept if result.record.pose_rounds else 0,
        "warned": bool(result.record.warnings),
    }


def line(key: str, row: Row) -> str:
    """Progress line of a finished reconstruction."""
    scores = ", ".join(f"{name} {found['psnr_db']:.2f}" for name, found in row["scores"].items())
    return f"{key}: {scores} dB, poses {row['tre_mm']:.2f} mm, {row['seconds']:.0f} s"


def by_subject(rows: Mapping[str, Row], preset: str, n_stacks: int) -> dict[str, Row]:
    """Rows of a preset and a number of stacks by subject.

    Args:
        rows: of the record.
        preset: settings.
        n_stacks: of the subject.
    """
    chosen = (row for row in rows.values() if (row["preset"], row["n_stacks"]) == (preset, n_stacks))
    return {row["subject"]: row for row in chosen}


def psnr_db(row: Row, name: str = "volume") -> float:
    """PSNR of a volume of a row."""
    return float(row["scores"][name]["psnr_db"])


def trade_table(rows: Mapping[str, Row]) -> str:
    """Table for three stacks, a row per subject with all presets."""
    found = {preset: by_subject(rows, preset, 3) for preset in TRADE}
    lines = []
    for spec in SUBJECTS:
        cells: dict[str, Any] = {"name": spec.name, "size": f"{spec.pixel_mm:g} x {spec.thickness_mm:g}"}
        for preset, of_preset in found.items():
            if row := of_preset.get(spec.name):
                cells["prior"] = f"{psnr_db(row, 'V_prior'):.2f}"  # of the last preset that has one
                cells |= {preset: f"{psnr_db(row):.2f}", f"{preset} s": f"{row['cpu_seconds']:.0f}"}
                cells |= {f"{preset} poses": f"{row['tre_mm']:.2f}"}
        lines.append(cells)
    lines.append({"name": "mean gain over the quicker one"} | _gains(found))
    columns: dict[str, Cell] = {"subject": "{name}", "pixel x slice, mm": "{size}"}
    for preset in TRADE:
        columns |= {f"`{preset}`, dB": f"{{{preset}}}", "CPU s" + " " * TRADE.index(preset): f"{{{preset} s}}"}
    columns["V_prior of the last"] = "{prior}"
    columns |= {f"poses, mm, `{preset}`": f"{{{preset} poses}}" for preset in TRADE}
    return table(lines, columns)


def _gains(found: Mapping[str, Mapping[str, Row]]) -> dict[str, str]:
    """Mean and smallest gain of each preset over the previous one."""
    gains = {}
    for quick, careful in pairwise(TRADE):
        both = sorted(set(found[quick]) & set(found[careful]))
        values = [psnr_db(found[careful][name]) - psnr_db(found[quick][name]) for name in both]
        if values:
            gains[careful] = f"{mean(values):+.2f} (least {min(values):+.2f})"
    return gains


def fewer_table(rows: Mapping[str, Row], wanted: Sequence[tuple[str, int]]) -> str:
    """Table for two stacks or one: the volume compared with V_prior and V_coarse.

    Args:
        rows: of the record.
        wanted: presets and numbers of stacks.
    """
    lines = []
    for preset, n_stacks in wanted:
        found = by_subject(rows, preset, n_stacks)
        for row in found.values():
            volume, prior, coarse = (psnr_db(row, name) for name in ("volume", "V_prior", "V_coarse"))
            lines.append({**row, "volume": volume, "prior": prior, "coarse": coarse, "gain": volume - prior})
    columns: dict[str, Cell] = {
        "subject": "{subject}",
        "stacks": "{n_stacks}",
        "preset": "`{preset}`",
        "CPU s": "{cpu_seconds:.0f}",
        "volume": "{volume:.2f}",
        "V_prior": "{prior:.2f}",
        "V_coarse": "{coarse:.2f}",
        "over V_prior": "{gain:+.2f}",
        "poses, mm": "{tre_mm:.2f}",
        "rounds": "{pose_rounds}",
    }
    return table(lines, columns)


def tables(record: Record) -> dict[str, str]:
    """The tables, with their subjects and settings."""
    made = f"Weights {record['weights']}; CPU seconds of the reconstruction without start and files."
    return {
        "presets": f"{made}\n\n{trade_table(record['rows'])}",
        "fewer-stacks": f"PSNR in dB.\n\n{fewer_table(record['rows'], ((FEWER_STACKS, 2), (TRADE[-1], 2)))}",
        "single-stack": f"PSNR in dB.\n\n{fewer_table(record['rows'], ((FEWER_STACKS, 1),))}",
    }


STUDY = Study(
    name="tradeoff.presets",
    about="Eight simulated heads of several sizes, pixels and slices, that no setting was chosen on: every preset with "
    "three stacks; two stacks and one.",
    shared=("--ckpt", "--threads", "--jobs", "--cache", "--cases"),
    tasks=tasks,
    tables=tables,
    document="tradeoff.md",
    picture="presets.png",
    figure=lambda record, options: draw_presets(record["rows"], TRADE, options.figure),
    line=line,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
