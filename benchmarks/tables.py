"""Tables of the documentation: made of figures, put between the markers that hold their place."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from g3r.errors import InputError


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table in Markdown; the first column is left-aligned, the others right.

    Raises:
        ValueError: a row of another length than the head.
    """
    for row in rows:
        if len(row) != len(head):
            raise ValueError(f"row of {len(row)} cells under {len(head)} columns")
    rule = ["---", *["---:"] * (len(head) - 1)]
    return "\n".join("| " + " | ".join(map(str, row)) + " |" for row in [head, rule, *rows])


def between_markers(text: str, name: str, content: str) -> str:
    """The text with what stands between `<!-- name:begin -->` and `<!-- name:end -->` replaced.

    Raises:
        InputError: the markers are not there exactly once, in this order.
    """
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise InputError(f"markers {begin} and {end} are not there once each; add them where the table goes")
    before, rest = text.split(begin)
    return f"{before}{begin}\n{content.strip()}\n{end}{rest.split(end)[1]}"


def put_into(path: Path, name: str, content: str) -> None:
    """Rewrite one table of a document in place.

    Raises:
        InputError: no such file, or no markers in it.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a document with {name} markers")
    try:
        text = between_markers(path.read_text(encoding="utf-8"), name, content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    _write(path, text)


def write_json(path: Path, record: Any) -> None:
    """Write a record, whole or not at all; folders are made."""
    _write(path, json.dumps(record, indent=1) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text, whole or not at all; folders are made."""
    _write(path, text.rstrip("\n") + "\n")


def _write(path: Path, text: str) -> None:
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.write_text(text, encoding="utf-8")
        os.replace(beside, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another --output") from None
