"""References in the documents exist: links, anchors, files, and functions in them."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from tests.rooms import REPOSITORY

DOCUMENTS = [
    *sorted((REPOSITORY / "docs").glob("*.md")),
    *(REPOSITORY / name for name in ("README.md", "CONTRIBUTING.md")),
]
FOLDERS = ("g3r", "data_synth", "studies", "tests", "lightning_configs", "docs", "examples")
MAX_CHARACTERS = 120
PLACEHOLDERS = ("ROOM", "PAGE", "NAME", "MODULE", "DIR", "*")


def name_of(path: Path) -> str:
    return path.relative_to(REPOSITORY).as_posix()


def file_of(text: str) -> Path | None:
    """The file or folder of a path in a document, relative to the repository or to g3r."""
    return next((path for path in (REPOSITORY / text, REPOSITORY / "g3r" / text) if path.exists()), None)


def anchors(path: Path) -> set[str]:
    """Anchors of a document's headings, as used in links."""
    titles = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_links_lead_somewhere(path: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8")):
        if link.startswith("http"):
            continue
        target, _, anchor = link.partition("#")
        there = path.parent / target if target else path
        assert there.exists(), link
        assert not anchor or anchor in anchors(there), link


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_files_that_are_named_exist(path: Path) -> None:
    rooms = {folder.name for folder in (REPOSITORY / "g3r").iterdir() if folder.is_dir()}
    for text in re.findall(r"`([\w.]+/[\w/.]+)`", path.read_text(encoding="utf-8")):
        if text.split("/")[0] in rooms | set(FOLDERS) and not any(word in text for word in PLACEHOLDERS):
            assert file_of(text), f"{name_of(path)}: {text}"


def names_defined(module: ast.Module) -> set[str]:
    """Names of functions, classes and fields, and of what is assigned to, anywhere in a module."""
    found = set()
    for node in ast.walk(module):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found |= {one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)}
    return found


def test_a_name_that_is_only_read_is_not_defined() -> None:
    module = ast.parse("from a import B\nC: int = B\nD, E = B.f(C)\nclass G:\n    h: B\n    def i(self): j = 1")
    assert names_defined(module) == {"C", "D", "E", "G", "h", "i", "j"}


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_functions_that_are_named_exist(path: Path) -> None:
    """References have the form `room/module.py`: `name` or `Class.name`."""
    for text, names in re.findall(r"`([\w/]+\.py)`: ((?:`[\w.]+`(?:, )?)+)", path.read_text(encoding="utf-8")):
        file = file_of(text)
        assert file, f"{name_of(path)}: {text}"
        defined = names_defined(ast.parse(file.read_text(encoding="utf-8")))
        for name in re.findall(r"`([\w.]+)`", names):
            assert set(name.split(".")) <= defined, f"{name_of(path)}: {text} has no {name}"


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_lines_are_short(path: Path) -> None:
    """Tables, and text that commands write between markers, are exempt."""
    text = re.sub(r"<!-- ([\w.-]+):begin -->.*?<!-- \1:end -->", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    long = [line for line in text.splitlines() if len(line) > MAX_CHARACTERS and not line.startswith("|")]
    assert not long, f"{name_of(path)}: {long[0]}"
