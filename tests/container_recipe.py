"""Parsers of the Dockerfile and the Apptainer recipe."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from tests.rooms import REPOSITORY

DOCKERFILE, APPTAINER = REPOSITORY / "Dockerfile", REPOSITORY / "apptainer.def"


@dataclass(frozen=True)
class Directive:
    """A directive of a Dockerfile: its keyword, and the rest of its logical line."""

    word: str
    text: str


def directives(path: Path = DOCKERFILE) -> list[Directive]:
    """The directives in order, without comments, with continued lines joined."""
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.lstrip().startswith("#")]
    logical = re.sub(r"\\\n\s*", " ", "\n".join(lines)).splitlines()
    parts = [line.strip().split(maxsplit=1) for line in logical if line.strip()]
    return [Directive(word=one[0], text=one[1] if len(one) > 1 else "") for one in parts]


def environment(path: Path = DOCKERFILE) -> dict[str, str]:
    """Variables set by ENV in the last stage."""
    words = [word for one in directives(path) if one.word == "ENV" for word in one.text.split()]
    return dict(word.split("=", 1) for word in words)


def argument(name: str, path: Path = DOCKERFILE) -> str:
    """The default of an ARG."""
    texts = [one.text for one in directives(path) if one.word == "ARG" and one.text.startswith(f"{name}=")]
    return texts[0].split("=", 1)[1].strip('"')


def pip_commands(path: Path = DOCKERFILE) -> list[str]:
    """The commands of pip in RUN, without the mounts of Docker."""
    runs = [re.sub(r"--mount=\S+\s+", "", one.text).strip() for one in directives(path) if one.word == "RUN"]
    return [run for run in runs if run.startswith("pip ")]


def sections(path: Path = APPTAINER) -> dict[str, list[str]]:
    """Lines of the recipe by section; lines before the first section are under ""."""
    found: dict[str, list[str]] = {"": []}
    name = ""
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("%"):
            name = line[1:].strip()
            found[name] = []
        elif line.strip() and not line.lstrip().startswith("#"):
            found[name].append(line.strip())
    return found
