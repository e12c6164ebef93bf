"""The example for Snakemake, run with a stand-in for g3r-infer; skipped where it is not installed."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from g3r.bids.dataset import find_sessions
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
    (tmp_path / "raw" / "sub-04" / "func").mkdir(parents=True)  # no anatomical images, so not for g3r
    return tmp_path / "raw"


@pytest.fixture
def g3r(tmp_path: Path) -> Path:
    """A command in place of g3r-bids that uses the stand-in."""
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


def test_participants_without_a_stack_are_not_listed(tmp_path: Path) -> None:
    """g3r-bids refuses such participants, and one refusal would leave the workflow unfinished."""
    for label, session, name in (
        ("04", None, "run-1"), ("01", "a", ""), ("02", "b", "acq-x_run-1"), ("05", None, "rec-a"), ("06", "a", "echo-1")
    ):  # fmt: skip
        add_session(tmp_path, label, session, [(name, b"image", b"mask")])
    for folder in ("sub-03/func", "sub-07/anat", "sub-08/ses-a/anat"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "sub-07" / "anat" / "sub-07_T1w.nii.gz").write_bytes(b"of another kind")
    (tmp_path / "sub-04" / "anat" / "sub-04_run-1_T2w.nii.gz").rename(tmp_path / "sub-04" / "anat" / "sub-04_T2w.nii")
    (tmp_path / "sub-09").write_text("a file")
    listing = SNAKEFILE.read_text(encoding="utf-8").split("\nrule ")[0]  # plain Python as far as the first rule
    found: dict[str, Any] = {"config": {"bids": str(tmp_path), "out": "out"}}
    exec(compile(listing, str(SNAKEFILE), "exec"), found)
    assert found["PARTICIPANTS"] == ["01", "02", "04"]
    assert found["PARTICIPANTS"] == sorted({one.participant for one in find_sessions(tmp_path) if one.stacks})


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
