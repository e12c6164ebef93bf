"""Sessions through submitit's debug executor, which runs them here, and messages without Slurm."""

from __future__ import annotations

import functools
import sys
from pathlib import Path

import pytest

from g3r.cli.bids import main
from tests.bids.cohorts import rows, volumes
from tests.bids.data_sets import BROKEN, add_session, ready_result, stand_in

# submitit's debug executor leaves its log files to the garbage collector
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

LINE = ("participant", "--slurm", "partition=quick")


@pytest.fixture
def raw(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three participants, the second broken, and a stand-in for g3r-infer."""
    for n in (1, 2, 3):
        add_session(tmp_path / "raw", f"0{n}", None, [("run-1", BROKEN if n == 2 else b"image", b"mask")])
    command = stand_in(ready_result(tmp_path / "ready"), tmp_path / "events")
    monkeypatch.setattr("g3r.bids.cohort.INFER", command)
    return tmp_path / "raw"


def test_sessions_in_an_array(raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rows equal those of the local pool, and finished sessions are not submitted again."""
    slurm = pytest.importorskip("g3r.bids.slurm", reason="the slurm extra is not installed")
    monkeypatch.setattr(slurm, "SlurmArrays", functools.partial(slurm.SlurmArrays, cluster="debug"))
    monkeypatch.setattr(slurm, "LONGEST_ARRAY", 2)
    out = tmp_path / "out"
    assert main([str(raw), str(out), *LINE]) == 1
    assert len(volumes(out)) == 2
    assert rows(out)["sub-02"]["reasons"].startswith("sub-02_run-1_T2w.nii.gz: not a readable NIfTI file")
    assert not (out / ".g3r" / "slurm").exists()
    n_events = len(list((tmp_path / "events").iterdir()))
    assert main([str(raw), str(out), *LINE]) == 1
    assert len(list((tmp_path / "events").iterdir())) == n_events + 1


def test_a_process_that_cannot_be_started(raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    slurm = pytest.importorskip("g3r.bids.slurm", reason="the slurm extra is not installed")
    monkeypatch.setattr(slurm, "SlurmArrays", functools.partial(slurm.SlurmArrays, cluster="debug"))
    monkeypatch.setattr("g3r.bids.cohort.INFER", ("no-such-command",))
    assert main([str(raw), str(tmp_path / "out"), *LINE]) == 1
    assert "could not be started" in rows(tmp_path / "out")["sub-01"]["reasons"]


def test_what_sbatch_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stated memory and cores, time limit and parallelism, followed by the user's options."""
    slurm = pytest.importorskip("g3r.bids.slurm", reason="the slurm extra is not installed")
    from submitit.slurm.slurm import _make_sbatch_string

    from g3r.bids.slurm_request import parsed_request

    arrays = slurm.SlurmArrays(
        folder=tmp_path, request=parsed_request("partition=quick,qos=low"), n_jobs=20, n_cores=4, needed_bytes=2**31
    )
    parameters = arrays._parameters(300)
    said = _make_sbatch_string(
        command="run",
        folder=tmp_path,
        map_count=300,
        time=parameters["timeout_min"],
        **{name.removeprefix("slurm_"): value for name, value in parameters.items() if name.startswith("slurm_")},
    )
    for word in ("cpus-per-task=4", "mem=2239M", "time=120", "array=0-299%20", "partition=quick", "qos=low"):
        assert f"#SBATCH --{word}\n" in said
    assert "--cpus-per-task=4" in said.split("srun")[-1]


def test_states_by_squeue(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("g3r.bids.slurm", reason="the slurm extra is not installed")
    from g3r.bids.slurm_queue import GONE, QueueWatcher

    watcher = QueueWatcher(delay_s=30)
    for job_id in ("7_0", "7_1", "8"):
        watcher.register_job(job_id)
    found = watcher.read_info("7_0|COMPLETED\n7_1|RUNNING\n9|PENDING\n")
    assert {job_id: one["State"] for job_id, one in found.items()} == {"7_0": "COMPLETED", "7_1": "RUNNING", "8": GONE}


def test_without_slurm_or_the_extra(
    raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    line = [str(raw), str(tmp_path / "out"), *LINE]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "submitit", None)
        patch.delitem(sys.modules, "g3r.bids.slurm", raising=False)
        assert main(line) == 3
    said = capsys.readouterr().err
    way_on = "install the slurm extra: pip install '.[slurm]' in a checkout"
    assert said == f"g3r-bids: submitit is not installed; {way_on}\n"
    pytest.importorskip("submitit", reason="the slurm extra is not installed")
    assert main(line) == 3
    said = capsys.readouterr().err
    assert said.startswith("g3r-bids: --slurm: no job was taken (Could not detect")
    assert len(said.splitlines()) == 1
    with pytest.raises(SystemExit) as caught:
        main([*line[:-1], "long"])
    assert caught.value.code == 2
