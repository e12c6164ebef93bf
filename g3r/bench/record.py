"""Records of measurements: machine, JSON, tables between the markers of a document; and how commands make them."""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from g3r._version import __version__
from g3r.errors import InputError, cannot_be_written
from g3r.run import atomic_file
from g3r.run.machine import available_cores

PACKAGES = ("numpy", "torch", "numba")
"""Packages whose versions influence speed."""


def machine(n_threads: int | None = None) -> dict[str, Any]:
    """The conditions of a timing: processor, cores, memory, versions, and the commit of a checkout.

    Args:
        n_threads: threads of the measurement; None for one per core.
    """
    return {
        "processor": _processor(),
        "cores": available_cores(),
        "threads": n_threads or available_cores(),
        "memory_gb": _memory_gb(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: _installed(name) for name in PACKAGES},
        "g3r": __version__,
        "commit": _commit(),
    }


def machine_line(found: dict[str, Any]) -> str:
    """The result of `machine` in one line, for below a table."""
    return (
        f"{found['processor']}, {found['cores']} cores, {found['threads']} threads; "
        f"Python {found['python']}, torch {found['torch']}, numba {found['numba']}; "
        f"g3r {found['g3r']}, commit {found['commit'] or 'unknown'}."
    )


def add_output_arguments(parser: argparse.ArgumentParser, name: str, figure: str) -> None:
    """Add the options of every measuring command for its record, tables and figure.

    Args:
        parser: parser of the command.
        name: name of the command.
        figure: what the figure shows; empty if there is none.
    """
    folder = Path("runs") / "bench" / name
    parser.add_argument("--output", type=Path, default=folder, help=f"for {name}.json and {name}.md")
    parser.add_argument("--docs", type=Path, metavar="FILE", help="also put the tables between its markers")
    if figure:
        parser.add_argument("--figure", type=Path, metavar="PNG", help=f"also draw {figure}")
    parser.add_argument("--redraw", action="store_true", help=f"no measuring: from --output's {name}.json")


def run_measurement(
    options: argparse.Namespace,
    name: str,
    *,
    measure: Callable[[Callable[[dict[str, Any]], None]], dict[str, Any]],
    tables: Callable[[dict[str, Any]], str],
    draw: Callable[[dict[str, Any], Path], None] | None = None,
) -> int:
    """Measure (or read the earlier record), write record, tables and figure; returns the exit code.

    Args:
        options: has those of `add_output_arguments`.
        name: name of the command, its files and its markers.
        measure: makes the record; called with a function that stores the record so far.
        tables: makes Markdown of the record.
        draw: draws the record as a figure; None for no figure.

    Raises:
        InputError: there is no earlier record, it is damaged, or files cannot be written.
    """
    path = options.output / f"{name}.json"
    if draw is not None and options.figure and options.figure.suffix != ".png":
        raise InputError(f"{options.figure}: expected a name that ends in .png; choose another --figure")
    if options.redraw:
        record, text = _earlier(path, tables)
    else:
        record = measure(lambda so_far: write_json(path, so_far))
        write_json(path, record)
        text = tables(record)
    write_text(options.output / f"{name}.md", text)
    print(text)
    if options.docs:
        put_between_markers(options.docs, name, text)
    if draw is not None and options.figure:
        try:
            draw(record, options.figure)
        except OSError as error:
            raise InputError(
                f"{options.figure}: cannot be written ({error.strerror}); choose another --figure, with --redraw"
            ) from None
    return 0


def _earlier(path: Path, tables: Callable[[dict[str, Any]], str]) -> tuple[dict[str, Any], str]:
    """The record of an earlier run, and its tables."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; measure first, without --redraw")
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        return record, tables(record)
    except (ValueError, LookupError, TypeError, AttributeError) as error:  # not JSON, or not such a record
        raise InputError(
            f"{path}: holds no record of g3r-bench {path.stem} ({type(error).__name__}: {error}); measure again, "
            "without --redraw"
        ) from None


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _memory_gb() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (ValueError, OSError, AttributeError):
        return None


def _installed(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Commit of the checkout that holds this file, with a + for uncommitted changes."""
    here = Path(__file__).resolve().parents[2]
    if not (here / ".git").exists():
        return None
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty=+", "--exclude=*"],
            cwd=here,
            capture_output=True,
            text=True,
            check=True,
            timeout=10,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return described.stdout.strip()


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table in Markdown; the first column is left-aligned, the others right.

    Args:
        head: names of the columns.
        rows: cells.

    Raises:
        ValueError: a row differs in length from the head.
    """
    for row in rows:
        if len(row) != len(head):
            raise ValueError(f"row of {len(row)} cells under {len(head)} columns")
    rule = ["---", *["---:"] * (len(head) - 1)]
    return "\n".join("| " + " | ".join(map(str, row)) + " |" for row in [head, rule, *rows])


def between_markers(text: str, name: str, content: str) -> str:
    """The text with new content between `<!-- name:begin -->` and `<!-- name:end -->`.

    Args:
        text: text of a document.
        name: name of the markers.
        content: new content between them.

    Raises:
        InputError: the markers are not there exactly once, in this order.
    """
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise InputError(f"markers {begin} and {end} are not there once each; add them where the table goes")
    before, rest = text.split(begin)
    return f"{before}{begin}\n{content.strip()}\n{end}{rest.split(end)[1]}"


def put_between_markers(path: Path, name: str, content: str) -> None:
    """Rewrite one table of a document in place.

    Args:
        path: path of the document.
        name: name of the markers.
        content: new content between them.

    Raises:
        InputError: the file does not exist, or has no such markers.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a document with {name} markers")
    try:
        text = between_markers(path.read_text(encoding="utf-8"), name, content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    _write(path, text)


def write_json(path: Path, record: Any) -> None:
    """Write a record, whole or not at all; folders are created."""
    _write(path, json.dumps(record, indent=1) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text, whole or not at all; folders are created."""
    _write(path, text.rstrip("\n") + "\n")


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_file.write_text(path, text)
    except OSError as error:
        raise cannot_be_written(path, error) from None
