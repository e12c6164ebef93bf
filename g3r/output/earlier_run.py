"""Running again what run.json records, and telling whether the inputs are the same."""

from __future__ import annotations

import hashlib
import json
import os
import types
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from g3r._version import __version__
from g3r.errors import InputError
from g3r.planning.presets import ReconstructionSettings

MAX_RECORD_BYTES = 50_000_000


@dataclass(frozen=True)
class FileHash:
    """A file by its name and the SHA-256 of its bytes."""

    name: str
    sha256: str

    @classmethod
    def of(cls, path: str | os.PathLike[str]) -> FileHash:
        """Of a file.

        Raises:
            InputError: it cannot be read.
        """
        try:
            with Path(path).open("rb") as file:
                return cls(Path(path).name, hashlib.file_digest(file, "sha256").hexdigest())
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None


@dataclass(frozen=True)
class Inputs:
    """The files that a result is made of.

    stacks, masks (empty without): one per stack; prior, pose_network: None where not used.
    """

    stacks: tuple[FileHash, ...]
    masks: tuple[FileHash, ...] = ()
    prior: FileHash | None = None
    pose_network: FileHash | None = None

    def named(self) -> dict[str, FileHash]:
        """All of them, by what they are."""
        marks = {f"stack {n + 1}": mark for n, mark in enumerate(self.stacks)}
        marks |= {f"mask {n + 1}": mark for n, mark in enumerate(self.masks)}
        marks |= {"prior": self.prior} if self.prior else {}
        return marks | ({"pose network": self.pose_network} if self.pose_network else {})

    def record(self) -> dict[str, Any]:
        """For run.json: names without paths."""
        return asdict(self)

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Inputs:
        """What `record` gave."""

        def marks(name: str) -> tuple[FileHash, ...]:
            return tuple(FileHash(**mark) for mark in record[name])

        def mark(name: str) -> FileHash | None:
            return FileHash(**record[name]) if record[name] else None

        return cls(marks("stacks"), marks("masks"), mark("prior"), mark("pose_network"))


@dataclass(frozen=True)
class EarlierRun:
    """What run.json says of a run.

    settings: as they were used; inputs; thickness_mm of each stack; n_threads; version of g3r; time_budget:
    what a budget chose and when loops ended, None without one.
    """

    settings: ReconstructionSettings
    inputs: Inputs
    thickness_mm: tuple[float, ...]
    n_threads: int
    version: str
    time_budget: dict[str, Any] | None

    def differences(self, inputs: Inputs) -> list[str]:
        """A sentence for each input that is not the same file's bytes, and for another version."""
        then, now = self.inputs.named(), inputs.named()
        said = [
            f"{name} ({mark.name}) is not the file that the configuration's result was made of"
            for name, mark in now.items()
            if name not in then or then[name].sha256 != mark.sha256
        ]
        said += [f"{name} ({then[name].name}) is not used now" for name in then if name not in now]
        if self.version != __version__:
            said.append(f"g3r is {__version__}, the configuration is of {self.version}")
        return [f"{sentence}: the volume will be another" for sentence in said]


def read_run(path: str | os.PathLike[str]) -> EarlierRun:
    """Read a run.json.

    Raises:
        InputError: it is no such file, or of a version with other settings.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_RECORD_BYTES:
            raise InputError(f"{path}: is too large for a run.json; pass one that g3r-infer wrote")
        record = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); pass a run.json") from None
    except (ValueError, RecursionError):
        raise InputError(f"{path}: is not JSON; pass a run.json that g3r-infer wrote") from None
    try:
        if record["partial"]:
            raise InputError(f"{path}: is of an interrupted run; pass the run.json of a whole result")
        return EarlierRun(
            _built(ReconstructionSettings, record["settings"]),
            Inputs.of_record(record["inputs"]),
            tuple(float(stack["thickness_mm"]) for stack in record["stacks"]),
            int(record["command"]["threads"]),
            str(record["g3r"]),
            _checked_budget(record["time_budget"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{path}: is not a run.json of this version of g3r ({type(error).__name__}: {error}); pass one "
            "that g3r-infer wrote"
        ) from None


def provenance(settings: ReconstructionSettings, inputs: Inputs, **further: object) -> dict[str, str]:
    """Everything that decides a result, by name: what a run must have in common with one that it resumes.

    Args:
        settings: that were asked for.
        inputs: files.
        further: other decisions, by name.
    """
    told = {name: mark.sha256 for name, mark in inputs.named().items()}
    told |= {f"setting {name}": repr(value) for name, value in _leaves(asdict(settings))}
    return told | {name: str(value) for name, value in further.items()} | {"g3r version": __version__}


def _leaves(settings: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for name, value in settings.items():
        if isinstance(value, Mapping):
            found += _leaves(value, f"{prefix}{name}.")
        else:
            found.append((prefix + name, value))
    return found


def _checked_budget(record: Any) -> dict[str, Any] | None:
    if record is None:
        return None
    loops = record["pace"]
    if not all(isinstance(x, int | float) for loop in loops for x in loop):
        raise ValueError("pace")
    return {**record, "seconds": float(record["seconds"]), "pace": [[float(x) for x in one] for one in loops]}


def _built(kind: Any, value: Any) -> Any:
    """A value of a settings class from its JSON, every field there and of its type."""
    if get_origin(kind) in (Union, types.UnionType):
        inner = [one for one in get_args(kind) if one is not type(None)]
        return None if value is None else _built(inner[0], value)
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        names = {field.name for field in fields(kind)}
        if set(value) != names:
            raise ValueError(f"settings {', '.join(sorted(set(value) ^ names))}")
        return kind(**{name: _built(hints[name], value[name]) for name in names})  # type: ignore[operator]
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, kind):
        raise ValueError(f"{value!r} where {kind.__name__} is expected")
    return value
