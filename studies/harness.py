"""Common command of all studies: options, a record from which an interrupted run resumes, tables, exit code.

A study itself defines only its tasks, its measurement, its tables and its figure; see `Study`.
`python -m studies.PAGE.NAME --help` lists the options of each.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from g3r.bench.record import machine, machine_line, put_between_markers, write_json, write_text
from g3r.errors import G3RError, InputError
from g3r.planning.presets import PRESETS
from g3r.run.machine import available_cores, use_up_to
from studies.worker import begin_worker

Row = dict[str, Any]
Record = dict[str, Any]

FOLDER = Path("runs") / "studies"
DOCS = Path(__file__).resolve().parents[1] / "docs"


@dataclass(frozen=True)
class Task:
    """One measurement.

    Attributes:
        key: name of its row in the record.
        call: function that measures. It returns the row, or None without a result (after printing why). A row with an
            entry "skipped" is tried again by the next run. With --jobs the call runs in another process.
        arguments: of the call.
    """

    key: str
    call: Callable[..., Row | None]
    arguments: tuple[Any, ...] = ()


def positive(text: str) -> int:
    """Option type: an integer of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}; expected at least 1")
    return int(text)


SHARED: dict[str, dict[str, Any]] = {
    "--preset": {"default": "balanced", "choices": PRESETS, "help": "settings"},
    "--ckpt": {"metavar": "PRIOR.safetensors", "help": "prior, or the name of a set (None: the one shipped)"},
    "--threads": {"type": positive, "metavar": "N", "help": "(None: all cores, shared out)"},
    "--jobs": {"type": positive, "metavar": "N", "default": 1, "help": "measurements at the same time"},
    "--cache": {"type": Path, "default": FOLDER / "subjects", "help": "simulated subjects"},
    "--development": {"action": "store_true", "help": "subjects that may be looked at"},
    "--cases": {"nargs": "+", "metavar": "GLOB", "default": ["*"], "help": "parts of the names of cases"},
    "folders": {"nargs": "*", "metavar": "CASE", "type": Path, "help": "of g3r-simulate (none: sta30-moderate)"},
}
"""Options that several studies have in common, with the same meaning in each."""

FITS = ("--preset", "--ckpt", "--threads")


@dataclass(frozen=True, kw_only=True)
class Study:
    """Definition of one study: everything that differs between studies.

    Attributes:
        name: PAGE.NAME, the module in `studies`.
        about: description for --help.
        tasks: function that makes the measurements from the options.
        tables: function that makes Markdown tables from the record, by the name of their markers in the document.
        document: file in docs/ into which --publish writes the tables; None publishes nothing.
        picture: file in docs/images/ for the figure of --publish.
        shared: names of the options of `SHARED` that the study takes.
        options: its own options, as arguments of `add_argument` by their name.
        settings: settings that rows depend on apart from the preset, weights, threads, jobs and --development.
        line: text that is printed for a new row; None prints its key and seconds.
        figure: draws the record into `options.figure`.
        finish: changes the record after the measurements.
        resumes: False repeats all measurements in each run.
        verdict: function of the record; a result of False makes the exit code 1.
    """

    name: str
    about: str
    tasks: Callable[[argparse.Namespace], Iterable[Task]]
    tables: Callable[[Record], Mapping[str, str]]
    document: str | None = None
    picture: str | None = None
    shared: tuple[str, ...] = FITS
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    settings: Callable[[argparse.Namespace], Record] | None = None
    line: Callable[[str, Row], str] | None = None
    figure: Callable[[Record, argparse.Namespace], None] | None = None
    finish: Callable[[Record, argparse.Namespace], None] | None = None
    resumes: bool = True
    verdict: Callable[[Record], bool] | None = None

    def parser(self) -> argparse.ArgumentParser:
        """Parser with all options of the study."""
        parser = argparse.ArgumentParser(
            prog=f"python -m studies.{self.name}",
            description=f"{self.about} The record is kept in --output, and a later run goes on with it.",
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )
        for name, arguments in ({name: SHARED[name] for name in self.shared} | dict(self.options)).items():
            parser.add_argument(name, **arguments)
        folder = FOLDER / self.name.replace(".", "-")
        parser.add_argument("--output", type=Path, default=folder, help="for the record as JSON and Markdown")
        parser.add_argument("--fresh", action="store_true", help="measure again what the record holds")
        parser.add_argument("--docs", type=Path, metavar="FILE", help="also put the tables between its markers")
        if self.figure:
            parser.add_argument("--figure", type=Path, metavar="PNG", help="also draw it")
        where = f"tables and figure into docs/{self.document}" if self.document else "nothing: in no document"
        parser.add_argument("--publish", action="store_true", help=where)
        return parser

    def main(self, argv: Sequence[str] | None = None) -> int:
        """Run the command; returns its exit code. An error of g3r is printed as one line and sets its exit code."""
        options = self.parser().parse_args(argv)
        logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s", stream=sys.stderr)
        try:
            return self.run(options)
        except G3RError as error:
            print(f"{self.name}: {error}", file=sys.stderr)
            return error.exit_code
        except KeyboardInterrupt:
            print(f"{self.name}: interrupted; the same command goes on from {options.output}", file=sys.stderr)
            return 130

    def run(self, options: argparse.Namespace) -> int:
        """Measure the rows that the record lacks; write record, tables and figure; returns the exit code."""
        if options.publish and self.document:
            options.docs = options.docs or DOCS / self.document
            if self.picture:
                options.figure = options.figure or DOCS / "images" / self.picture
        if options.docs and getattr(options, "development", False):
            raise InputError(
                "--docs, --publish: the published table needs seeds not looked at; leave out --development"
            )
        settings = self._settings(options)
        tasks = list(self.tasks(options))
        path = options.output / f"{self.name.split('.')[-1]}.json"
        renewed = {task.key for task in tasks} if options.fresh or not self.resumes else set()
        here = machine(settings.get("threads"))
        record = resumed(path, {**settings, "machine": here, "rows": {}}, renewed)
        rows = record["rows"]
        todo = [task for task in tasks if task.key not in rows]
        start = time.perf_counter()
        for n, (task, row) in enumerate(results(todo, settings.get("jobs", 1), settings.get("threads")), 1):
            if row is not None:
                rows[task.key] = row | {"commit": here["commit"]}
                record["machine"] = here | {"commit": commits(rows)}
                left = left_text(n, len(todo), time.perf_counter() - start)
                print((self.line(task.key, row) if self.line else f"{task.key}: measured") + left, flush=True)
                write_json(path, record)
        print(f"{len(todo)} of {len(tasks)} measured, {time.perf_counter() - start:.0f} s", flush=True)
        order = {task.key: n for n, task in enumerate(tasks)}
        record["rows"] = dict(sorted(rows.items(), key=lambda item: order.get(item[0], len(order))))
        if self.finish:
            self.finish(record, options)
        write_json(path, record)
        texts = self.tables(record)
        write_text(path.with_suffix(".md"), "\n\n".join(texts.values()))
        print("\n\n".join(texts.values()))
        for marker, text in texts.items():
            if options.docs:
                put_between_markers(options.docs, marker, stated(text, record))
        if self.figure and options.figure:
            self.figure(record, options)
        return 0 if self.verdict is None or self.verdict(record) else 1

    def _settings(self, options: argparse.Namespace) -> Record:
        """Settings that all rows of a record depend on."""
        found: Record = {}
        if hasattr(options, "preset"):
            found["preset"] = options.preset
        if hasattr(options, "ckpt"):
            found["weights"] = weights(options.ckpt)
        jobs = getattr(options, "jobs", None)
        if jobs is not None:
            found["jobs"] = jobs
        if hasattr(options, "threads"):
            found["threads"] = options.threads or max(1, available_cores() // (jobs or 1))
        if hasattr(options, "development"):
            found["development"] = options.development
        return found | (self.settings(options) if self.settings else {})


def stated(text: str, record: Record) -> str:
    """Published tables with machine, commit and weights of their record, unless they say them already.

    Args:
        text: in Markdown.
        record: with what `g3r.bench.record.machine` found.
    """
    if "commit " in text or "|" not in text:
        return text
    unsaid = "weights" in record and record["weights"] not in text
    return f"{text}\n\n{machine_line(record['machine'])}" + f" Prior of weights {record.get('weights')}." * unsaid


def left_text(n_done: int, n_all: int, seconds: float) -> str:
    """Remaining measurements and time of a run, for the end of a progress line; empty after the last measurement.

    Args:
        n_done: measurements of this run so far.
        n_all: measurements of this run.
        seconds: time of this run so far.
    """
    if n_done == n_all:
        return ""
    minutes = seconds / n_done * (n_all - n_done) / 60
    return f" ({n_done} of {n_all}, about {max(1, round(minutes))} min left)"


def resumed(path: Path, new: Record, renewed: set[str]) -> Record:
    """The record of an earlier run with the same settings, or the new record.

    Args:
        path: of the record; the file need not exist.
        new: record with settings and machine, without rows.
        renewed: keys of rows that are to be measured again.

    Raises:
        InputError: the file cannot be read, or holds rows of other settings that this run does not replace.
    """
    if not path.is_file():
        return new
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        rows = {key: row for key, row in found["rows"].items() if key not in renewed and "skipped" not in row}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not a record of a study ({error}); choose another --output") from None
    if not rows:
        return new
    other = [name for name in new if name not in ("machine", "rows") and found.get(name) != new[name]]
    if other:
        listed = ", ".join(f"{name} {found.get(name)} instead of {new[name]}" for name in other)
        raise InputError(f"{path}: measured with {listed}; choose another --output, or remove it")
    print(f"{path}: {len(rows)} rows kept, of commit {found['machine']['commit']}; --fresh measures again")
    before = found["machine"]["commit"]
    rows = {key: {"commit": before} | row for key, row in rows.items()}  # of records that hold it for all rows alone
    return {**found, "machine": found["machine"] | {"commit": commits(rows)}, "rows": rows}


def commits(rows: Mapping[str, Row]) -> str:
    """The commits that rows were measured with, without duplicates, in the order of the rows."""
    return ", ".join(dict.fromkeys(str(row["commit"] or "unknown") for row in rows.values()))


def results(tasks: Sequence[Task], jobs: int, threads: int | None) -> Iterator[tuple[Task, Row | None]]:
    """Run tasks and yield each with its row as it finishes.

    Args:
        tasks: to run.
        jobs: number of processes; 1 runs everything in this process.
        threads: per process; None does not change them.
    """
    if jobs == 1 or len(tasks) < 2:
        if threads:
            use_up_to(threads)
        for task in tasks:
            yield task, task.call(*task.arguments)
        return
    # a fresh interpreter for each worker, because thread pools do not survive a fork
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, spawn, initializer=begin_worker, initargs=(threads or 1,)) as pool:
        waiting = {pool.submit(task.call, *task.arguments): task for task in tasks}
        try:
            for done in as_completed(waiting):
                yield waiting[done], done.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)  # results of the remaining tasks would be lost
            raise


def weights(checkpoint: str | None) -> str:
    """The first 16 digits of the SHA-256 of a prior's file, which identify the weights that rows were measured with.

    Raises:
        InputError: no such file.
    """
    from g3r.checkpoints.shipped import weights_path

    path = weights_path(checkpoint, "prior")
    if not path.is_file():
        raise InputError(f"--ckpt {path}: no such file")
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
