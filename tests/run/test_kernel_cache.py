"""The cache of compiled kernels: kept on disk if possible; kernels run even if home and package are read-only."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from g3r.run import kernel_cache as _kernel_cache
from g3r.run.kernel_cache import ensure_kernel_cache, kept_in, may_write, needs_compiling

PACKAGE = Path(_kernel_cache.__file__).parents[1]

RUN = """
import numpy as np
import g3r
from g3r.gaussians.kernels import derive_shapes
shapes = np.zeros((1, 10))
one = np.array([[1.0, 0, 0, 0]])
derive_shapes(np.ones((1, 3)), np.zeros((1, 3)), one, shapes)
assert shapes[0].tolist() == [1, 1, 1, 1, 0, 0, 1, 0, 1, 1], shapes
from pathlib import Path
from g3r.run.kernel_cache import kept_in, needs_compiling
assert str(kept_in(Path(g3r.__file__).parent / "gaussians")) == derive_shapes.stats.cache_path
assert not needs_compiling()
print(g3r.__file__, derive_shapes.stats.cache_hits)
"""


@pytest.fixture
def blocked(tmp_path: Path) -> dict[str, str]:
    """A copy of the package and a home folder in which no user can create anything.

    Permissions do not stop root, but a file in place of a folder does.
    """
    source = tmp_path / "installed" / "g3r"
    shutil.copytree(PACKAGE, source, ignore=shutil.ignore_patterns("__pycache__", "*.safetensors"))
    for folder in [source, *(path for path in source.rglob("*") if path.is_dir())]:
        (folder / "__pycache__").write_text("")
    home = tmp_path / "home"
    home.write_text("")
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    drop = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "PYTHONPATH")
    kept = {name: value for name, value in os.environ.items() if name not in drop}
    return kept | {"HOME": str(home), "TMPDIR": str(temporary), "PYTHONPATH": str(source.parent)}


def run(environment: dict[str, str], folder: Path) -> tuple[Path, str]:
    done = subprocess.run(
        [sys.executable, "-c", RUN], env=environment, cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    path, hits = done.stdout.split(" ", 1)
    return Path(path), hits.strip()


@pytest.mark.skipif(sys.platform == "win32", reason="homes are elsewhere")
def test_kernels_run_and_are_kept_with_nothing_to_write_but_temporary_files(
    blocked: dict[str, str], tmp_path: Path
) -> None:
    path, hits = run(blocked, tmp_path)
    assert path.is_relative_to(tmp_path)  # the copy, not the package under test
    assert hits == "Counter()"
    folder = next((tmp_path / "tmp").iterdir())
    assert list(folder.rglob("*.nbc"))
    assert not folder.stat().st_mode & 0o077
    assert run(blocked, tmp_path)[1] != "Counter()"  # the second process compiles nothing


@pytest.mark.skipif(sys.platform == "win32", reason="homes are elsewhere")
def test_kernels_are_kept_and_found_in_the_cache_folder_of_the_user(blocked: dict[str, str], tmp_path: Path) -> None:
    home = tmp_path / "user"
    home.mkdir()
    assert run(blocked | {"HOME": str(home)}, tmp_path)[1] == "Counter()"
    assert list((home / ".cache" / "numba").rglob("*.nbi")) or sys.platform == "darwin"
    assert run(blocked | {"HOME": str(home)}, tmp_path)[1] != "Counter()"


@pytest.mark.skipif(sys.platform == "win32", reason="homes are elsewhere")
def test_a_folder_of_somebody_else_is_not_used(blocked: dict[str, str], tmp_path: Path) -> None:
    """Cache content is run as code, and any user may create folders among the temporary files."""
    planted = tmp_path / "tmp" / f"g3r-kernels-{os.getuid()}"
    planted.mkdir()
    planted.chmod(0o777)
    run(blocked, tmp_path)
    assert list(planted.iterdir()) == []


def test_a_folder_that_was_chosen_stays(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(_kernel_cache, "may_write", lambda folder: False)
    ensure_kernel_cache()
    assert os.environ["NUMBA_CACHE_DIR"] == str(tmp_path)


def test_may_write(tmp_path: Path) -> None:
    assert may_write(tmp_path)
    assert may_write(tmp_path / "a" / "b")
    (tmp_path / "file").write_text("")
    assert not may_write(tmp_path / "file")
    assert not may_write(tmp_path / "file" / "below")


@pytest.mark.parametrize("place", ["chosen", "package", "user"])
def test_compiled_kernels_are_found(place: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """They are found in the chosen folder, in the package, or, if that is read-only, in the user's cache folder."""
    package, home = tmp_path / "g3r", tmp_path / "home"
    for room in ("acquisition", "gaussians"):
        (package / room).mkdir(parents=True)
    monkeypatch.setattr(_kernel_cache, "PACKAGE", package)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(_kernel_cache, "_user_cache", lambda: home)
    if place == "chosen":
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "chosen"))
    if place == "user":
        monkeypatch.setattr(_kernel_cache, "may_write", lambda folder: folder == home)
    assert needs_compiling()
    assert keep(package / "acquisition").is_relative_to(tmp_path / {"package": "g3r", "user": "home"}.get(place, place))
    assert not needs_compiling()
    assert needs_compiling("gaussians")
    keep(package / "gaussians")
    assert not needs_compiling("gaussians")


def keep(room: Path) -> Path:
    """Create an empty file where numba would cache a kernel of a room."""
    path = kept_in(room) / "kernels.forward-217.py311.nbi"
    path.parent.mkdir(parents=True)
    path.touch()
    return path


def test_kernels_of_another_copy_or_program_in_the_same_folder_do_not_count(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "chosen"))
    monkeypatch.setattr(_kernel_cache, "PACKAGE", tmp_path / "g3r")
    (tmp_path / "g3r" / "gaussians").mkdir(parents=True)
    keep(tmp_path / "elsewhere" / "gaussians")
    assert needs_compiling("gaussians")
    assert needs_compiling()
