"""Architecture rules: imports between rooms, lazy imports, forbidden text."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.rooms import (
    DATA_SYNTH_MAY_IMPORT,
    DOCUMENT,
    FRONT_DOOR,
    MAY_IMPORT,
    REPOSITORY,
    allowed,
    imported_modules,
    room_of,
    rooms_imported,
    with_table,
)

SOURCES = sorted(
    path for folder in ("g3r", "data_synth", "studies", "tests") for path in (REPOSITORY / folder).rglob("*.py")
)
TEXT_SUFFIXES = {".py", ".md", ".toml", ".txt", ".yaml", ".yml", ".cff", ".cfg", ".sh", ".json", ""}
IGNORED_FOLDERS = {"runs", "lightning_logs", "out", "demo", "build", "dist"}


def relative(path: Path) -> str:
    return path.relative_to(REPOSITORY).as_posix()


def in_package(name: str) -> list[Path]:
    return [path for path in SOURCES if path.is_relative_to(REPOSITORY / name)]


def test_imports_go_downwards_and_every_allowance_is_used() -> None:
    used: dict[str, set[str]] = {room: set() for room in MAY_IMPORT}
    for path in in_package("g3r"):
        if room_of(path) != FRONT_DOOR:  # it may import every room; its laziness is tested below
            used[room_of(path)] |= rooms_imported(path) - {room_of(path)}
    assert used == {room: allowed(room) for room in MAY_IMPORT}, "say in tests/rooms.py what a room imports"


def test_no_room_imports_one_that_is_above_it() -> None:
    order = list(MAY_IMPORT)
    for room in order:
        assert all(order.index(other) < order.index(room) for other in allowed(room)), room


def test_every_folder_and_loose_module_is_a_room() -> None:
    assert {room_of(path) for path in in_package("g3r")} - {FRONT_DOOR} == set(MAY_IMPORT)


def test_the_table_of_rooms_in_contributing_is_the_one_that_is_held() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    assert with_table(text) == text, "run `python -m tests.rooms`"


def test_only_the_pretrain_command_knows_lightning() -> None:
    users = {
        relative(path)
        for path in in_package("g3r")
        if any(name.split(".")[0] in ("lightning", "torchio") for name in imported_modules(path))
    }
    assert all(user.startswith("g3r/training/") or user == "g3r/cli/pretrain.py" for user in users)
    trainers = {relative(path) for path in in_package("g3r/cli") if "training" in rooms_imported(path)}
    assert trainers == {"g3r/cli/pretrain.py"}


@pytest.mark.parametrize("path", in_package("data_synth"), ids=relative)
def test_data_synth_uses_only_the_lower_rooms(path: Path) -> None:
    # g3r-simulate handles errors like the other commands
    own = {"cli"} if path.name == "cli.py" else set()
    assert rooms_imported(path) <= DATA_SYNTH_MAY_IMPORT | own, relative(path)


def test_g3r_does_not_know_data_synth() -> None:
    for path in in_package("g3r"):
        assert not any(name.split(".")[0] == "data_synth" for name in imported_modules(path)), relative(path)


def test_nothing_installed_knows_the_studies() -> None:
    for path in [*in_package("g3r"), *in_package("data_synth")]:
        assert not any(name.split(".")[0] == "studies" for name in imported_modules(path)), relative(path)


MAX_LINES = 300


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_no_file_is_long(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MAX_LINES


KEYWORD_ONLY_FROM = 5
"""Fields of a record; places of so many are mixed up."""


def fields_of_records(path: Path) -> Iterator[tuple[str, int, bool]]:
    """Name, number of fields of its own, and whether it is keyword-only, of each dataclass in a file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.ClassDef):
            continue
        decorators = [ast.unparse(one) for one in node.decorator_list]
        if any(one.split("(")[0] == "dataclass" for one in decorators):
            n_fields = sum(isinstance(line, ast.AnnAssign) for line in node.body)
            yield node.name, n_fields, any("kw_only=True" in one for one in decorators)


@pytest.mark.parametrize("folder", ["g3r", "data_synth", "studies"])
def test_records_with_many_fields_are_keyword_only(folder: str) -> None:
    for path in in_package(folder):
        for name, n_fields, keyword_only in fields_of_records(path):
            assert keyword_only or n_fields < KEYWORD_ONLY_FROM, f"{relative(path)}: {name}"


def modules_after(statement: str, *wanted: str) -> set[str]:
    """The packages, of those wanted, that a fresh interpreter has loaded after a statement."""
    code = (
        f"import json, sys\ntry:\n    {statement}\nexcept SystemExit:\n    pass\n"
        f"print('\\n' + json.dumps([m for m in {list(wanted)!r} if m in sys.modules]))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=REPOSITORY)
    assert run.returncode == 0, run.stderr
    return set(json.loads(run.stdout.splitlines()[-1]))


HEAVY = ("torch", "monai", "lightning", "torchio", "matplotlib", "SimpleITK")
FOR_SOME = ("numba", "scipy", "pydicom")
"""Packages that only some runs need; nibabel imports pydicom if it is installed."""


def test_import_g3r_is_light() -> None:
    assert modules_after("import g3r", *HEAVY, *FOR_SOME) == set()


def test_load_stack_needs_no_torch() -> None:
    assert modules_after("from g3r import load_stack", *HEAVY) == set()


def test_the_pipeline_is_imported_without_the_libraries_of_its_networks() -> None:
    heavy = ("torch", "monai", "matplotlib", "lightning", "torchio", "pytorch_lightning")
    assert modules_after("import g3r.reconstruct", *heavy) == set()


def test_the_networks_need_no_training_packages() -> None:
    statement = "import g3r.prior.model, g3r.pose_network.model, g3r.mask_network.model"
    assert modules_after(statement, "lightning", "torchio", "pytorch_lightning") == set()


def test_a_preview_loads_no_network(subject: Path, tmp_path: Path) -> None:
    files = [[str(subject / f"{kind}-{n}.nii.gz") for n in range(3)] for kind in ("stack", "mask")]
    line = ["--stacks", *files[0], "--masks", *files[1], "--thickness", "4", "--output", str(tmp_path / "out")]
    line += ["--preset", "preview", "--resolution", "1.5", "--threads", "1", "--quiet"]
    statement = f"import g3r.cli.infer as c; assert c.main({line!r}) == 0"
    assert modules_after(statement, "torch", "monai", "matplotlib") == set()


REUSE = ("render", "apply", "export_poses")
COMMANDS = [f"g3r.cli.{name}" for name in ("infer", "bids", "evaluate", "pretrain", "export", "bench", *REUSE)] + [
    "data_synth.cli"
]


@pytest.mark.parametrize("option", ["--help", "--version"])
@pytest.mark.parametrize("command", COMMANDS)
def test_help_and_version_are_light(command: str, option: str) -> None:
    statement = f"import {command} as c; c.main([{option!r}])"
    assert modules_after(statement, *HEAVY, *FOR_SOME, "numpy") == set()


@pytest.mark.parametrize("command", ["scaling", "trade"])
def test_help_of_a_benchmark_is_light(command: str) -> None:
    statement = f"import g3r.cli.bench as c; c.main(['{command}', '--help'])"
    assert modules_after(statement, *HEAVY, *FOR_SOME, "numpy") == set()


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
    except (OSError, subprocess.CalledProcessError):  # not a git repository, such as an unpacked archive
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
    # written in pieces, so that the search does not find this file
    machine = re.compile("|".join(re.escape(a + b) for a, b in [("/wo", "rk/"), ("/ho", "me/"), ("/ro", "ot/")]))
    shared = ".." + "/shared"
    for path in repository_texts():
        text = path.read_text(encoding="utf-8", errors="ignore")
        assert not machine.search(text), f"{relative(path)} names a path of one machine"
        assert shared not in text, f"{relative(path)} names a folder outside the repository"


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_source_has_a_name_and_a_docstring(path: Path) -> None:
    assert path.stem not in {"utils", "util", "helpers", "misc"}, "a function without a home: name the concept"
    if not path.is_relative_to(REPOSITORY / "tests"):  # the name of a test describes it
        docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
        assert docstring, f"{relative(path)} has no module docstring"
