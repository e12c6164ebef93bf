"""The rules of the house: which room may import which, what stays lazy, what the text may not say."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]

# What each room may import of ours. The errors, the version and deadlines are open to all.
BELOW_FITTING = {"geometry", "acquisition", "gaussians", "motion", "prior"}
ALLOWED = {
    "errors": set(),
    "_version": set(),
    "pace": set(),
    "_kernel_cache": set(),
    "geometry": set(),
    "acquisition": {"geometry"},
    "gaussians": {"geometry", "acquisition"},
    "motion": {"geometry", "acquisition", "gaussians"},
    "prior": {"geometry", "acquisition", "gaussians"},
    "fitting": BELOW_FITTING,
    "trust": {"geometry", "acquisition", "gaussians", "fitting"},
    "evaluation": {"geometry", "acquisition"},
    "report": BELOW_FITTING | {"fitting"},
    "presets": BELOW_FITTING | {"fitting"},
}
OPEN_TO_ALL = {"errors", "_version", "pace"}
ALLOWED["interruption"] = set()
ALLOWED["unfinished"] = set()
ALLOWED["stage_file"] = set()
ALLOWED["start"] = BELOW_FITTING
ALLOWED["memory"] = BELOW_FITTING | {"fitting", "presets", "start"}
ALLOWED["budget"] = BELOW_FITTING | {"fitting", "presets", "start"}
ALLOWED["run_record"] = BELOW_FITTING | {"fitting", "memory", "presets"}
ALLOWED["rerun"] = {"presets"}
ALLOWED["stages"] = BELOW_FITTING | {"fitting", "run_record", "stage_file", "start"}
ROOMS = {*ALLOWED, "result", "finish", "reconstruct", "bench", "cli"}
ALLOWED["result"] = ROOMS - {"finish", "reconstruct", "bench", "cli", "result"}
ALLOWED["finish"] = ROOMS - {"reconstruct", "bench", "cli", "finish"}
ALLOWED["reconstruct"] = ROOMS - {"bench", "cli", "reconstruct"}
ALLOWED["bench"] = ROOMS - {"cli", "bench"}  # it measures the whole way of the data
ALLOWED["cli"] = ROOMS - {"cli"}
DATA_SYNTH_MAY = {"geometry", "acquisition", "run"} | OPEN_TO_ALL

SOURCES = sorted(
    path for folder in ("g3r", "data_synth", "studies", "tests") for path in (REPOSITORY / folder).rglob("*.py")
)
TEXT_SUFFIXES = {".py", ".md", ".toml", ".txt", ".yaml", ".yml", ".cff", ".cfg", ".sh", ".json", ""}
IGNORED_FOLDERS = {"runs", "lightning_logs", "out", "demo", "build", "dist"}


def imported_modules(path: Path) -> set[str]:
    """Dotted names of everything a file imports, wherever in the file."""
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
    """The rooms of g3r that a file imports from."""
    return {name.split(".")[1] for name in imported_modules(path) if name.startswith("g3r.")}


def room_of(path: Path) -> str:
    return path.relative_to(REPOSITORY / "g3r").with_suffix("").parts[0]


def relative(path: Path) -> str:
    return path.relative_to(REPOSITORY).as_posix()


def in_package(name: str) -> list[Path]:
    return [path for path in SOURCES if path.is_relative_to(REPOSITORY / name)]


@pytest.mark.parametrize("path", in_package("g3r"), ids=relative)
def test_imports_go_downwards(path: Path) -> None:
    room = room_of(path)
    if room == "__init__":
        pytest.skip("the front door may name every room; that it stays lazy is tested below")
    assert room in ALLOWED, f"{room} is a new room: say in ALLOWED what it may import"
    forbidden = (rooms_imported(path) & ROOMS) - ALLOWED[room] - OPEN_TO_ALL - {room}
    assert not forbidden, f"{relative(path)} ({room}) imports from {sorted(forbidden)}"


@pytest.mark.parametrize("path", in_package("data_synth"), ids=relative)
def test_data_synth_uses_only_the_lower_rooms(path: Path) -> None:
    forbidden = rooms_imported(path) - DATA_SYNTH_MAY
    assert not forbidden, f"{relative(path)} imports g3r.{sorted(forbidden)}"


def test_g3r_does_not_know_data_synth() -> None:
    for path in in_package("g3r"):
        assert not any(name.split(".")[0] == "data_synth" for name in imported_modules(path)), relative(path)


def test_nothing_installed_knows_the_benchmarks() -> None:
    for path in [*in_package("g3r"), *in_package("data_synth")]:
        assert not any(name.split(".")[0] == "studies" for name in imported_modules(path)), relative(path)


def modules_after(statement: str, *wanted: str) -> set[str]:
    """Which of the wanted packages a fresh interpreter has loaded after a statement."""
    code = (
        f"import json, sys\ntry:\n    {statement}\nexcept SystemExit:\n    pass\n"
        f"print('\\n' + json.dumps([m for m in {list(wanted)!r} if m in sys.modules]))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=REPOSITORY)
    assert run.returncode == 0, run.stderr
    return set(json.loads(run.stdout.splitlines()[-1]))


HEAVY = ("torch", "monai", "lightning", "torchio", "matplotlib", "SimpleITK")


def test_import_g3r_is_light() -> None:
    assert modules_after("import g3r", *HEAVY, "numba", "scipy") == set()


def test_load_stack_needs_no_torch() -> None:
    assert modules_after("from g3r import load_stack", *HEAVY) == set()


def test_the_pipeline_needs_no_training_packages() -> None:
    assert modules_after("import g3r.reconstruct", "lightning", "torchio", "pytorch_lightning") == set()


@pytest.mark.parametrize("command", ["infer", "evaluate", "pretrain", "export", "bench"])
def test_help_is_light(command: str) -> None:
    statement = f"import g3r.cli.{command} as c; c.main(['--help'])"
    assert modules_after(statement, *HEAVY, "numba", "scipy", "numpy") == set()


@pytest.mark.parametrize("command", ["scaling", "trade"])
def test_help_of_a_benchmark_is_light(command: str) -> None:
    statement = f"import g3r.cli.bench as c; c.main(['{command}', '--help'])"
    assert modules_after(statement, *HEAVY, "numba", "scipy", "numpy") == set()


def test_unknown_public_name() -> None:
    import g3r

    assert {"GaussianReconstructor", "load_stack", "__version__"} <= set(dir(g3r))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = g3r.nothing


def repository_texts() -> list[Path]:
    """Text files of the repository: tracked and new ones, or all outside of ignored folders."""
    try:
        listed = subprocess.run(
            ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
            capture_output=True,
            text=True,
            check=True,
            cwd=REPOSITORY,
        ).stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):  # an unpacked archive
        listed = [
            relative(path)
            for path in REPOSITORY.rglob("*")
            if not any(
                part in IGNORED_FOLDERS or (part.startswith(".") and part != ".ci") or part.endswith(".egg-info")
                for part in path.relative_to(REPOSITORY).parts
            )
        ]
    paths = [REPOSITORY / name for name in listed]
    return [path for path in paths if path.is_file() and path.suffix in TEXT_SUFFIXES]


def test_no_path_of_one_machine() -> None:
    # spelled in pieces, so that this file does not find itself
    machine = re.compile("|".join(re.escape(a + b) for a, b in [("/wo", "rk/"), ("/ho", "me/"), ("/ro", "ot/")]))
    shared = ".." + "/shared"
    for path in repository_texts():
        text = path.read_text(encoding="utf-8", errors="ignore")
        assert not machine.search(text), f"{relative(path)} names a path of one machine"
        assert shared not in text, f"{relative(path)} names a folder outside the repository"


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_source_has_a_name_and_a_docstring(path: Path) -> None:
    assert path.stem not in {"utils", "util", "helpers", "misc"}, "a function without a home: name the concept"
    if not path.is_relative_to(REPOSITORY / "tests"):  # a test's name says what it is about
        docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
        assert docstring, f"{relative(path)} has no module docstring"
