"""The commands shown in README.md and docs/: found in code blocks, parsed by the commands' own parsers."""

from __future__ import annotations

import argparse
import importlib
import re
import shlex
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import pytest
import yaml

from tests.rooms import REPOSITORY

SHELLS = {"bash", "console", "powershell", "sh"}

OTHERS = {
    "antsApplyTransforms",
    "apptainer",
    "docker",
    "nesvor",
    "pip",
    "py",
    "snakemake",
    "source",
    "wsl",
    "g3r-envScriptsactivate",  # for Windows: a POSIX shell removes its backslashes
}
"""Third-party programs, which no test runs."""

THREE_STACKS = "ax.nii.gz cor.nii.gz sag.nii.gz"

GOES_ON = {"g3r-bench", "g3r-bids"}
"""Commands whose first parser leaves arguments to a second one."""


class Parsed(Exception):
    """Raised when the options of a command were parsed."""


@dataclass(frozen=True)
class Shown:
    """A command in a document."""

    document: str
    line: str

    @property
    def words(self) -> list[str]:
        """Words as split by a shell, with a file for each "..." after an option."""
        line = self.line.replace("--masks ...", "--masks ax-mask.nii.gz cor-mask.nii.gz sag-mask.nii.gz")
        return shlex.split(re.sub(r"(?<=\w)\.\.\.", "", line.replace("--stacks ...", f"--stacks {THREE_STACKS}")))

    @property
    def is_synopsis(self) -> bool:
        """Whether it marks optional parts."""
        return bool(re.search(r" \[[-\w]", self.line))


def blocks(text: str) -> Iterator[tuple[str, list[str]]]:
    """Code blocks with the name of their language, "" for indented ones."""
    language, lines = "", list[str]()
    fenced = False
    for line in text.splitlines():
        mark = re.match(r"```(\w*)", line)
        if mark or not (fenced or line.startswith("    ")):
            if lines:
                yield language, lines
            fenced, lines = bool(mark) and not fenced, []
            language = mark[1] if mark and fenced else ""
        else:
            lines.append(line if fenced else line[4:])
    if lines:
        yield language, lines


def commands(document: str, text: str) -> Iterator[Shown]:
    """All shell lines; of indented blocks, which also hold equations, only lines of our own commands."""
    for language, lines in blocks(text):
        if language not in SHELLS | {""}:
            continue
        whole = re.sub(r"\s*\\\n\s*", " ", "\n".join(lines)).splitlines()
        for line in (re.sub(r"(^|\s+)#.*", "", one).strip() for one in whole):
            own = re.match(r"(g3r-[a-z-]+|make|python3? -m|\.venv/bin/\w+) ", f"{line} ")
            if line and (language or own):
                yield Shown(document, line)


def all_commands() -> list[Shown]:
    """The commands of all documents for users and developers."""
    paths = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *sorted((REPOSITORY / "docs").glob("*.md"))]
    return [
        one
        for path in paths
        for one in commands(path.relative_to(REPOSITORY).as_posix(), path.read_text(encoding="utf-8"))
    ]


@cache
def scripts() -> dict[str, str]:
    """The commands of the package and their entry points."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return dict(project["scripts"])


def main_of(command: str) -> Any:
    """The function behind a command."""
    module, name = scripts()[command].split(":")
    return getattr(importlib.import_module(module), name)


def parse(words: list[str], patch: pytest.MonkeyPatch) -> None:
    """Let a command parse its options and do nothing else.

    Raises:
        SystemExit: the options are invalid.
    """
    plain = argparse.ArgumentParser.parse_args

    def parse_args(self: argparse.ArgumentParser, *given: Any, **named: Any) -> Any:
        found = plain(self, *given, **named)
        if self.prog in GOES_ON:
            return found
        raise Parsed

    def stop(*given: Any) -> int:
        raise Parsed

    patch.setattr(argparse.ArgumentParser, "parse_args", parse_args)
    patch.setattr("g3r.cli.bids._run", stop)
    with pytest.raises(Parsed):
        main_of(words[0])(words[1:])


def check_training(words: list[str]) -> None:
    """`g3r-pretrain fit --config FILE --a.b VALUE`: the file exists, and it or Lightning defines each option."""
    assert words[1] == "fit"
    assert words[2] == "--config"
    settings = yaml.safe_load((REPOSITORY / words[3]).read_text(encoding="utf-8"))
    for option in (word.removeprefix("--") for word in words[4:] if word.startswith("--")):
        inner = settings
        for key in option.split("."):
            known = {**inner, **inner.get("init_args", {})}
            assert option == "ckpt_path" or key in known, option
            inner = known.get(key, {})


def check_make(words: list[str]) -> None:
    """`make TARGET NAME=VALUE`: Makefile has both."""
    text = (REPOSITORY / "Makefile").read_text(encoding="utf-8")
    for word in words[1:]:
        name, equals, _ = word.partition("=")
        if equals:
            assert f"$({name})" in text or f"$({name}," in text or f"$(if $({name})" in text, word
        elif name.startswith("study-"):
            assert (REPOSITORY / "studies" / f"{name.removeprefix('study-').replace('.', '/')}.py").is_file(), word
        else:
            assert re.search(rf"^{re.escape(name)}:", text, flags=re.MULTILINE), word
