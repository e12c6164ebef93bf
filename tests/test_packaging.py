"""The packages that users install: built from the source distribution, installed into a clean environment."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

from g3r._version import __version__
from tests.rooms import REPOSITORY

BUILT_FROM = ("g3r", "data_synth", "pyproject.toml", "README.md", "LICENSE")


def run(*line: str | Path, cwd: Path) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    words = [str(word) for word in line]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=cwd, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from a source distribution, in a copy of the sources."""
    pytest.importorskip("build", reason="the dev extra is not installed")
    sources = tmp_path_factory.mktemp("sources")
    for name in BUILT_FROM:
        path = REPOSITORY / name
        if path.is_dir():
            shutil.copytree(path, sources / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(path, sources / name)
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", sources / "dist", sources, cwd=sources)
    return sources / "dist"


def test_a_wheel_from_the_source_distribution_works_in_a_clean_environment(dist: Path, tmp_path: Path) -> None:
    assert len(list(dist.glob("*.tar.gz"))) == 1
    (wheel,) = dist.glob("*.whl")
    venv.create(tmp_path / "clean", with_pip=False, symlinks=True)
    scripts = tmp_path / "clean" / ("Scripts" if sys.platform == "win32" else "bin")
    paths = {"base": str(tmp_path / "clean"), "platbase": str(tmp_path / "clean")}
    site = Path(sysconfig.get_path("purelib", "venv", paths))
    run(
        sys.executable,
        "-m",
        "pip",
        "--python",
        scripts / "python",
        "install",
        "--no-deps",
        "--quiet",
        wheel,
        cwd=tmp_path,
    )
    # required libraries come from this environment, after the packages of the clean one
    (site / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    where = run(scripts / "python", "-c", "import g3r, data_synth; print(g3r.__file__)", cwd=tmp_path).strip()
    assert Path(where).is_relative_to(tmp_path)
    commands = ("infer", "mask", "bids", "simulate", "evaluate", "pretrain", "export", "bench", "render", "apply")
    for command in (*commands, "export-poses"):
        assert run(scripts / f"g3r-{command}", "--version", cwd=tmp_path).split() == [f"g3r-{command}", __version__]
    code = "import g3r, g3r.uncertainty.estimate as e; g3r.GaussianReconstructor(); e.calibration()"
    run(scripts / "python", "-c", code, cwd=tmp_path)
