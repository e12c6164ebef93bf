"""Kernels are kept on disk wherever that is possible, and run where home and package are read-only."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from g3r.run import kernel_cache as _kernel_cache
from g3r.run.kernel_cache import ensure_kernel_cache, may_write, needs_compiling

PACKAGE = Path(_kernel_cache.__file__).parents[1]

RUN = """
import numpy as np
import g3r
from g3r.gaussians.kernels import derive_shapes
shapes = np.zeros((1, 10))
one = np.array([[1.0, 0, 0, 0]])
derive_shapes(np.ones((1, 3)), np.zeros((1, 3)), one, shapes)
assert shapes[0].tolist() == [1, 1, 1, 1, 0, 0, 1, 0, 1, 1], shapes
print(g3r.__file__, derive_shapes.stats.cache_hits)
"""


@pytest.fixture
def blocked(tmp_path: Path) -> dict[str, str]:
    """A copy of the package and a home in which nothing can be made, whoever tries.

    Permissions do not hold back root; a file in a folder's place does.
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
def test_a_folder_of_somebody_else_is_not_used(blocked: dict[str, str], tmp_path: Path) -> None:
    """What lies in the cache is run as code, and anybody may make folders among the temporary files."""
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


def test_compiled_kernels_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert needs_compiling()
    (tmp_path / "acquisition_ab").mkdir()
    (tmp_path / "acquisition_ab" / "kernels.scatter-91.py311.nbi").touch()
    assert not needs_compiling()
    assert needs_compiling("gaussians")
    (tmp_path / "gaussians_ab").mkdir()
    (tmp_path / "gaussians_ab" / "kernels.forward-217.py311.nbi").touch()
    assert not needs_compiling("gaussians")


def test_compiled_kernels_of_the_package_are_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(_kernel_cache, "PACKAGE", tmp_path)
    assert needs_compiling("gaussians")
    (tmp_path / "gaussians" / "__pycache__").mkdir(parents=True)
    (tmp_path / "gaussians" / "__pycache__" / "kernels.forward-217.py311.nbi").touch()
    assert not needs_compiling("gaussians")
