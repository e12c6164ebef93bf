"""`python -m studies.cohort.cost`: time, memory and files of one subject of g3r-bids, and of a page of a thousand."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import psutil

from g3r.bench.record import machine_line
from g3r.bids.dataset import Session
from g3r.bids.derivative import SECTIONS, THUMBNAIL, figure_path
from g3r.bids.index_page import PAGE, write_index
from g3r.bids.outcome import FAILED, Outcome
from g3r.bids.table import TABLE, write_table
from g3r.errors import InputError
from g3r.report.verdict_messages import CHECK, DO_NOT_USE, USE
from studies.harness import Record, Row, Study, Task, positive
from studies.tables import table

SUBJECT = ("--phantom", "30", "--resolution", "0.8", "--thickness", "3", "--seed", "61004")
"""Options of g3r-simulate for a usual examination: three stacks, about a hundred slices."""

MB = 1e6
POLL_S = 0.2


def add_subject(case: Path, root: Path) -> None:
    """Add a simulated case to a BIDS data set, with its masks among the derivatives."""
    for kind, folder in (("stack", root), ("mask", root / "derivatives" / "masks")):
        anat = folder / "sub-01" / "anat"
        anat.mkdir(parents=True, exist_ok=True)
        for path in sorted(case.glob(f"{kind}-*.nii.gz")):
            n = path.name.split("-")[1].split(".")[0]
            end = "T2w" if kind == "stack" else "desc-brain_mask"
            shutil.copy(path, anat / f"sub-01_run-{n}_{end}.nii.gz")
    (root / "dataset_description.json").write_text(json.dumps({"Name": "one", "BIDSVersion": "1.10.0"}))


def subject(folder: Path) -> Row:
    """Measure one subject of g3r-bids from start to end, with no other process on its cores.

    Raises:
        InputError: it was not reconstructed.
    """
    from data_synth import cli as simulate

    case, raw, out = folder / "case", folder / "raw", folder / "out"
    simulate.main([*SUBJECT, "--force", "--output", str(case)])
    for one in (raw, out):
        shutil.rmtree(one, ignore_errors=True)
    add_subject(case, raw)
    words = [sys.executable, "-m", "g3r.cli.bids", str(raw), str(out), "participant", "--jobs", "1"]
    start_s, before = time.perf_counter(), os.times()
    work_bytes = held_bytes = 0
    with subprocess.Popen([*words, "--", "--thickness", "3"], stdout=subprocess.DEVNULL) as run:
        while run.poll() is None:
            work_bytes = max(work_bytes, sum(_sizes(out / ".g3r")))
            held_bytes = max(held_bytes, _held_bytes(run.pid))
            time.sleep(POLL_S)
    seconds, after = time.perf_counter() - start_s, os.times()
    if run.returncode:
        raise InputError(f"g3r-bids ended with {run.returncode}; see {out / 'logs'}")
    kept = list(_sizes(out / "sub-01"))
    return {
        "seconds": seconds,
        "cpu_seconds": after.children_user + after.children_system - before.children_user - before.children_system,
        "held_bytes": held_bytes,
        "n_files": len(kept) + 1,  # plus the log
        "kept_bytes": sum(kept),
        "work_bytes": work_bytes,
        "thumbnail_bytes": figure_path(_session("01"), out, THUMBNAIL).stat().st_size,
        "sections_bytes": figure_path(_session("01"), out).stat().st_size,
    }


def page(folder: Path, n: int) -> Row:
    """Measure table and page of `n` sessions, one in ten with a problem; the pictures are empty files."""
    out = folder / "page"
    shutil.rmtree(out, ignore_errors=True)
    verdicts = [FAILED, DO_NOT_USE, CHECK, *[USE] * 27]
    outcomes = [_outcome(number, verdicts[number % len(verdicts)]) for number in range(n)]
    for one in outcomes:
        for end in (SECTIONS, THUMBNAIL) if one.verdict != FAILED else ():
            path = figure_path(one.session, out, end)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
    start_s = time.perf_counter()
    write_table(outcomes, out)
    write_index(outcomes, out)
    seconds = time.perf_counter() - start_s
    return {
        "n": n,
        "seconds": seconds,
        "page_bytes": (out / PAGE).stat().st_size,
        "table_bytes": (out / TABLE).stat().st_size,
    }


def _session(label: str) -> Session:
    return Session(participant=label, session=None, stacks=())


def _outcome(number: int, verdict: str) -> Outcome:
    session = _session(f"{number:04d}")
    if verdict == FAILED:
        why = f"{session.stem}_run-2_T2w.nii.gz: cannot be read " * 3
        return Outcome(session=session, verdict=verdict, reasons=(why,))
    reasons = () if verdict == USE else ("registration probably failed; do not rely on the volume",)
    return Outcome(
        session=session, verdict=verdict, seconds=60.0, n_stacks=3, n_slices=100, n_used=95, unseen_share=0.01,
        reasons=reasons
    )  # fmt: skip


def _sizes(folder: Path) -> Iterator[int]:
    """Bytes of each file below a folder; files that disappear meanwhile are skipped."""
    for path in folder.rglob("*") if folder.is_dir() else ():
        with suppress(OSError):
            if path.is_file():
                yield path.stat().st_size


def _held_bytes(pid: int) -> int:
    """Resident memory of a process and its children."""
    with suppress(psutil.Error):
        one = psutil.Process(pid)
        return sum(int(process.memory_info().rss) for process in (one, *one.children(recursive=True)))
    return 0


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """Two tasks: the subject and the page."""
    yield Task("subject", subject, (options.output,))
    yield Task("page", page, (options.output, options.sessions))


def tables(record: Record) -> dict[str, str]:
    """Costs of one session, and of the whole cohort."""
    one, many = record["rows"].get("subject"), record["rows"].get("page")
    if not one or not many:
        return {}
    n, small, large = many["n"], one["thumbnail_bytes"], one["sections_bytes"]
    rows = [
        ("CPU time", f"{one['cpu_seconds']:.0f} s", f"{one['cpu_seconds'] * n / 3600:.0f} h of one core"),
        ("time", f"{one['seconds']:.0f} s", ""),
        ("memory, `g3r-bids` included", f"{one['held_bytes'] / 1e9:.2f} GB", ""),
        ("files that stay", f"{one['n_files']}", f"{one['n_files'] * n:,}"),
        ("bytes that stay", f"{one['kept_bytes'] / MB:.1f} MB", f"{one['kept_bytes'] * n / 1e9:.1f} GB"),
        ("bytes while it runs", f"{one['work_bytes'] / MB:.0f} MB", "of those that run at once"),
        ("small picture, on the page", f"{small / 1e3:.0f} kB", f"{small * n / MB:.0f} MB"),
        ("large picture, behind it", f"{large / 1e3:.0f} kB", f"{large * n / MB:.0f} MB"),
        ("`index.html`", f"{many['page_bytes'] / n / 1e3:.2f} kB", f"{many['page_bytes'] / 1e3:.0f} kB"),
        ("`participants_g3r.tsv`", f"{many['table_bytes'] / n:.0f} B", f"{many['table_bytes'] / 1e3:.0f} kB"),
        ("writing both", "", f"{many['seconds']:.2f} s"),
    ]  # fmt: skip
    heads = ("what", "one session", f"{n:,} sessions")
    cells = {head: f"{{{head}}}" for head in heads}
    text = table([dict(zip(heads, row, strict=True)) for row in rows], cells)
    return {"cohort-cost": f"{text}\n\n{machine_line(record['machine'])}"}


STUDY = Study(
    name="cohort.cost",
    about="What one subject costs by g3r-bids at its defaults, and the table and page of many.",
    document="cohort.md",
    shared=("--threads",),
    options={"--sessions": {"type": positive, "default": 1000, "help": "rows of the page"}},
    settings=lambda options: {"sessions": options.sessions},
    tasks=tasks,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
