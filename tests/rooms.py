"""Allowed imports between the rooms of g3r, checked by tests/test_architecture.py and written into CONTRIBUTING.md.

`python -m tests.rooms` writes the table between the markers of CONTRIBUTING.md, and counts rooms, floors and pairs.
"""

from __future__ import annotations

import ast
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
DOCUMENT = REPOSITORY / "CONTRIBUTING.md"
BEGIN, END = "<!-- rooms -->", "<!-- /rooms -->"

OPEN_TO_ALL = {"errors", "_version"}

MAY_IMPORT = {
    "errors": "",
    "_version": "",
    "run": "",
    "geometry": "run",
    "acquisition": "geometry run",
    "checkpoints": "run",
    "dicom": "geometry run acquisition",
    "gaussians": "geometry run acquisition",
    "prior": "geometry acquisition checkpoints",
    "pose_network": "geometry acquisition checkpoints",
    "mask_network": "geometry acquisition checkpoints",
    "masking": "acquisition mask_network",
    "registration": "geometry run acquisition",
    "evaluation": "geometry acquisition registration",
    "training": "geometry run checkpoints prior pose_network mask_network evaluation",
    "fitting": "geometry run acquisition gaussians registration prior",
    "uncertainty": "geometry run acquisition gaussians fitting",
    "planning": "run acquisition gaussians prior registration fitting",
    "networks": "geometry run acquisition checkpoints prior pose_network fitting planning",
    "output": "geometry run acquisition gaussians registration fitting uncertainty planning",
    "reuse": "geometry acquisition gaussians registration output",
    "report": "geometry run acquisition registration fitting planning output reuse",
    "bids": "geometry run acquisition report",
    "reconstruct": "run acquisition checkpoints registration fitting planning networks output report",
    "bench": "geometry run acquisition gaussians registration fitting planning evaluation output reconstruct",
    "cli": (
        "run acquisition dicom checkpoints prior pose_network mask_network masking training planning evaluation output "
        "bids reuse report reconstruct"
    ),
}
"""Rooms from the bottom up: a room imports only rooms that precede it here, and `errors` and `_version`."""

DATA_SYNTH_MAY_IMPORT = {"geometry", "acquisition", "run"}

FRONT_DOOR = "__init__"


def allowed(room: str) -> set[str]:
    """Rooms that a room may import."""
    return set(MAY_IMPORT[room].split())


def imported_modules(path: Path) -> set[str]:
    """Dotted names of all imports of a file, at any level."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    package = path.relative_to(REPOSITORY).with_suffix("").parts[:-1]
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*base, *([node.module] if node.module else [])))
            names.update(f"{module}.{alias.name}" for alias in node.names)
    return names


def rooms_imported(path: Path) -> set[str]:
    """The rooms of g3r that a file imports from, except those open to all."""
    found = {name.split(".")[1] for name in imported_modules(path) if name.startswith("g3r.")}
    return (found & set(MAY_IMPORT)) - OPEN_TO_ALL


def room_of(path: Path) -> str:
    """The room of g3r that a file is in."""
    return path.relative_to(REPOSITORY / "g3r").with_suffix("").parts[0]


def table() -> str:
    """The rooms from the bottom up, with the first line of their docstrings."""
    lines = ["| room | holds | may import |", "|---|---|---|"]
    for room, may in MAY_IMPORT.items():
        folder = REPOSITORY / "g3r" / room
        path = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
        docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        name = f"`{room}/`" if folder.is_dir() else f"`{room}.py`"
        holds = docstring.splitlines()[0].split(": ", 1)[-1].rstrip(".")
        lines.append(f"| {name} | {holds} | {', '.join(may.split()) or 'nothing of ours'} |")
    return "\n".join(lines)


def with_table(text: str) -> str:
    """A document with the table between its markers."""
    before, rest = text.split(BEGIN)
    return f"{before}{BEGIN}\n{table()}\n{END}{rest.split(END)[1]}"


def floor(room: str) -> int:
    """Length of the longest chain of imports that ends at this room, including the open rooms."""
    below = set() if room in OPEN_TO_ALL else allowed(room) | OPEN_TO_ALL
    return 1 + max(map(floor, below), default=0)


if __name__ == "__main__":
    DOCUMENT.write_text(with_table(DOCUMENT.read_text(encoding="utf-8")), encoding="utf-8")
    loose = [room for room in MAY_IMPORT if not (REPOSITORY / "g3r" / room).is_dir()]
    pairs = sum(len(allowed(room)) for room in MAY_IMPORT)
    print(
        f"{len(MAY_IMPORT)} rooms, {len(loose)} of them loose modules; {pairs} import pairs, the open rooms apart; "
        f"{max(map(floor, MAY_IMPORT))} floors"
    )
