"""The example for Snakemake, run with a stand-in for g3r-infer; skipped where it is not installed."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from g3r.bids.pool import NEEDED_BYTES
from g3r.bids.slurm_request import CORES, MINUTES
from tests.bids.cohorts import rows, volumes
from tests.bids.data_sets import BROKEN, add_session, ready_result, stand_in
from tests.rooms import REPOSITORY

SNAKEMAKE = shutil.which("snakemake", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}")

SNAKEFILE = REPOSITORY / "examples" / "Snakefile"

needs_snakemake = pytest.mark.skipif(
    SNAKEMAKE is None, reason="snakemake is not on the PATH (it asks for older packages than g3r is tested with)"
)


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    for label in ("01", "02", "03"):
        content = BROKEN if label == "02" else b"image"
        add_session(tmp_path / "raw", label, "a" if label == "03" else None, [("run-1", content, b"mask")])
    return tmp_path / "raw"


@pytest.fixture
def g3r(tmp_path: Path) -> Path:
    """A command like g3r-bids."""
    command = stand_in(ready_result(tmp_path / "ready"), tmp_path / "events")
    path = tmp_path / "g3r-bids"
    path.write_text(
        f"#!{sys.executable}\nimport sys\nsys.path.insert(0, {str(REPOSITORY)!r})\nfrom g3r.bids import cohort\n"
        f"cohort.INFER = {command!r}\nfrom g3r.cli.bids import main\nsys.exit(main())\n"
    )
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def snakemake(tmp_path: Path, raw: Path, g3r: Path, *words: str) -> subprocess.CompletedProcess[str]:
    line = [str(SNAKEMAKE), "--snakefile", str(SNAKEFILE), "--directory", str(tmp_path)]
    line += [*words, "--cores", "2", "--config", f"bids={raw}", f"out={tmp_path / 'out'}", f"g3r={g3r}"]
    said = dict(os.environ, XDG_CACHE_HOME=str(tmp_path / "cache"))
    return subprocess.run(line, env=said, capture_output=True, text=True, check=False)


def test_it_states_what_g3r_bids_reckons_with() -> None:
    text = SNAKEFILE.read_text(encoding="utf-8")
    assert f"mem_mb={NEEDED_BYTES // 1_000_000}," in text
    assert f"runtime={MINUTES}," in text
    assert f"threads: {CORES}" in text


@needs_snakemake
def test_a_job_for_each_participant_and_one_at_the_end(tmp_path: Path, raw: Path, g3r: Path) -> None:
    done = snakemake(tmp_path, raw, g3r, "--dry-run")
    assert done.returncode == 0, done.stderr
    said = done.stdout + done.stderr
    assert said.count("rule participant:") == 3
    assert said.count("rule group:") == 1
    assert "mem_mb=1500" in said
    assert not (tmp_path / "out").exists()


@needs_snakemake
def test_what_failed_is_in_the_table_and_is_tried_again(tmp_path: Path, raw: Path, g3r: Path) -> None:
    assert snakemake(tmp_path, raw, g3r, "--keep-going").returncode == 1
    out = tmp_path / "out"
    assert {name: row["verdict"] for name, row in rows(out).items()} == {
        "sub-01": "use", "sub-02": "failed", "sub-03": "trusted"
    }  # fmt: skip
    made = volumes(out)
    (raw / "sub-02" / "anat" / "sub-02_run-1_T2w.nii.gz").write_bytes(b"mended")
    done = snakemake(tmp_path, raw, g3r, "--keep-going")
    assert done.returncode == 0, done.stderr
    assert len(volumes(out)) == 3
    assert made.items() <= volumes(out).items()
    assert rows(out)["sub-02"]["verdict"] == "use"
