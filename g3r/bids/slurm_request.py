"""The request `--slurm partition=NAME[,key=value...]`: options of sbatch, without those that g3r-bids decides."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

DECIDED = {
    "array": "--jobs says how many run at once",
    "chdir": "paths of the command hold from here",
    "error": "it is kept where the result is looked for",
    "nodes": "a session needs one",
    "ntasks": "a session is one task",
    "ntasks-per-node": "a session is one task",
    "output": "it is kept where the result is looked for",
    "signal": "g3r-bids listens to its own",
    "wrap": "g3r-bids writes the script",
}
"""Options of sbatch that cannot be passed, and why."""

MINUTES = 120
"""Default time limit of a session, without `time`; the longest preset takes 10 minutes on two cores."""

CORES = 2
"""Default cores of each session, without `cpus_per_task` and --threads."""

TIME = re.compile(r"(?:(?P<days>\d+)-)?(?P<clock>\d+(?::\d+){0,2})")


@dataclass(frozen=True, kw_only=True)
class SlurmRequest:
    """Resources of one session, and further options of sbatch.

    Attributes:
        minutes: time limit.
        n_cores: cores of its task; None for the number in the options of g3r-infer.
        options: options of sbatch, by name without leading dashes.
    """

    minutes: int = MINUTES
    n_cores: int | None = None
    options: Mapping[str, str]


def parsed_request(text: str) -> SlurmRequest:
    """The request in words `key=value,key=value`; a key may be written with `_` or `-`.

    Raises:
        ValueError: a word lacks a value, a key is in `DECIDED`, the time or the number of cores is invalid.
    """
    options: dict[str, str] = {}
    for word in text.split(","):
        key, equals, value = (part.strip() for part in word.partition("="))
        key = key.lstrip("-").replace("_", "-")
        if not (key and equals and value):
            raise ValueError(f"{word!r} in {text!r}; expected partition=NAME[,key=value...]")
        if key in DECIDED:
            raise ValueError(f"{key}={value} cannot be passed ({DECIDED[key]}); leave it out")
        options[key] = value
    cores = options.pop("cpus-per-task", None)
    if cores is not None and not (cores.isdigit() and int(cores)):
        raise ValueError(f"cpus_per_task={cores}; expected a number of cores")
    minutes = _minutes(options.pop("time")) if "time" in options else MINUTES
    return SlurmRequest(minutes=minutes, n_cores=int(cores) if cores else None, options=options)


def _minutes(text: str) -> int:
    """Minutes from Slurm's time formats: 90, 90:00, 1:30:00; after days hours come first: 1-12, 1-12:30.

    Raises:
        ValueError: the text is not a time.
    """
    found = TIME.fullmatch(text)
    if not found or not any(map(int, re.findall(r"\d+", text))):
        raise ValueError(f"time={text}; expected minutes, HOURS:MINUTES:SECONDS, or DAYS-HOURS")
    clock = [int(part) for part in found["clock"].split(":")]
    hours_first = found["days"] is not None or len(clock) == 3
    hours, minutes = (*clock, 0)[:2] if hours_first else (0, clock[0])
    return max(1, int(found["days"] or 0) * 1440 + hours * 60 + minutes)
