"""Stored stage results, so that a later run resumes after the last finished stage."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from g3r.errors import InputError
from g3r.run.atomic_file import write_text
from g3r.run.stage_file import UnreadableStage, as_stored, read_stage, write_stage

logger = logging.getLogger(__name__)

PROVENANCE_NAME = "provenance.json"

Result = TypeVar("Result")


@dataclass(frozen=True)
class FinishedStage:
    """Result of a stage of an earlier run, and the seconds that it took."""

    value: Any
    seconds: float
    cpu_seconds: float


class StageStore:
    """Stores stage results in a folder, one file per stage.

    Args:
        folder: for the files; None stores nothing.
        provenance: everything that determines the results, by name.
        records: dataclasses that the results may hold.
        resume: whether to read existing stages rather than begin anew.

    Raises:
        InputError: the existing stages have another provenance.
    """

    def __init__(
        self,
        folder: Path | None = None,
        provenance: Mapping[str, str] | None = None,
        records: Sequence[type] = (),
        *,
        resume: bool = False,
    ) -> None:
        self.folder = folder
        self.records = records
        self.reads = resume
        self.resumed: list[str] = []
        if folder is None:
            return
        path = folder / PROVENANCE_NAME
        if resume and path.exists():
            _refuse_other(folder, path, provenance or {})
        self._begin(path, provenance or {})

    def read(self, name: str) -> FinishedStage | None:
        """Result of a stage of an earlier run; None if it has to be computed."""
        path = self._path(name)
        if path is None or not self.reads or not path.exists():
            return None
        try:
            seconds, cpu_seconds, value = read_stage(path, self.records)
        except UnreadableStage as error:
            logger.warning("%s; it is made again", error)
            return None
        self.resumed.append(str(name))
        logger.info("%s: taken from the earlier run", name)
        return FinishedStage(value, seconds, cpu_seconds)

    def as_stored(self, value: Result) -> Result:
        """A value as its file would return it, so that a run with and without files computes the same."""
        return as_stored(value)

    def write(self, name: str, value: Any, seconds: float, cpu_seconds: float) -> None:
        """Store the result of a stage. On a full disk the store is dropped and the run goes on.

        Args:
            name: name of the stage.
            value: its result.
            seconds: wall-clock time that it took.
            cpu_seconds: processor time that it took.
        """
        path = self._path(name)
        if path is None:
            return
        try:
            write_stage(path, (seconds, cpu_seconds, value))
        except OSError as error:
            self._give_up(error)

    def _path(self, name: str) -> Path | None:
        return None if self.folder is None else self.folder / f"{name.replace(' ', '-')}.npz"

    def _begin(self, provenance_path: Path, provenance: Mapping[str, str]) -> None:
        assert self.folder is not None
        try:
            if not self.reads and self.folder.exists():
                for path in self.folder.iterdir():
                    path.unlink()
            self.folder.mkdir(parents=True, exist_ok=True)
            write_text(provenance_path, json.dumps(dict(provenance), indent=2) + "\n")
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        logger.warning("%s: stages cannot be kept (%s); --resume will not find them", self.folder, error.strerror)
        self.folder = None


def _refuse_other(folder: Path, path: Path, provenance: Mapping[str, str]) -> None:
    try:
        earlier = json.loads(path.read_text(encoding="utf-8"))
        differing = sorted(key for key in {*earlier, *provenance} if earlier.get(key) != provenance.get(key))
    except (OSError, ValueError, AttributeError, TypeError):
        differing = ["a file that cannot be read"]
    if differing:
        raise InputError(
            f"{folder}: --resume: the earlier run differs in {', '.join(differing)}; pass what it was given, "
            "or leave out --resume to begin anew"
        )
