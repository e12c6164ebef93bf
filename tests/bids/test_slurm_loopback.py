"""Sessions in arrays of a real Slurm on this machine; skipped where it is not installed."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from g3r.cli.bids import main
from tests.bids.cohorts import rows, volumes
from tests.bids.data_sets import BROKEN, ENDLESS, HUNGRY, add_session, ready_result, stand_in
from tests.bids.loopback_slurm import loopback_slurm, missing

pytest.importorskip("submitit", reason="the slurm extra is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(missing() is not None, reason=f"no Slurm here: {missing()}")]

SLURM = ["--slurm", "partition=quick,time=1,mem=300M,cpus_per_task=1"]


@pytest.fixture(scope="module", autouse=True)
def running_slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with loopback_slurm(tmp_path_factory.mktemp("slurm") / "loopback", cores=4):
        yield


@pytest.fixture(autouse=True)
def short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("g3r.bids.slurm.POLL_S", 0.2)
    monkeypatch.setattr("g3r.bids.slurm.SIGNAL_BEFORE_S", 0)


def data_set(folder: Path, contents: dict[str, bytes]) -> Path:
    for label, content in contents.items():
        add_session(folder, label, None, [("run-1", content, b"mask")])
    return folder


def use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds: float = 0.0) -> tuple[str, ...]:
    if not (tmp_path / "ready").exists():
        ready_result(tmp_path / "ready")
    command = stand_in(tmp_path / "ready", tmp_path / "events", seconds)
    monkeypatch.setattr("g3r.bids.cohort.INFER", command)
    return command


def events(tmp_path: Path) -> list[dict[str, Any]]:
    return [json.loads(path.read_text()) for path in (tmp_path / "events").iterdir()]


def is_empty_soon() -> bool:
    """Whether the queue becomes empty; jobs that have written their result need a moment to leave it."""
    until_s = time.monotonic() + 15
    while time.monotonic() < until_s:
        if not subprocess.run(["squeue", "--noheader"], capture_output=True, text=True, check=True).stdout:
            return True
        time.sleep(0.2)
    return False


def test_an_array_of_sessions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At most --jobs tasks run, one bad session stops no other, and finished sessions are not submitted again."""
    raw = data_set(tmp_path / "raw", {f"0{n}": BROKEN if n == 4 else b"image" for n in range(1, 7)})
    out = tmp_path / "out"
    use(tmp_path, monkeypatch, 1.0)
    line = [str(raw), str(out), "participant", "--jobs", "2", *SLURM]
    assert main(line) == 1
    assert len(volumes(out)) == 5
    assert rows(out)["sub-04"]["reasons"].startswith("sub-04_run-1_T2w.nii.gz: not a readable NIfTI file")
    assert float(rows(out)["sub-04"]["seconds"]) < 30
    spans = [(one["began"], one["ended"]) for one in events(tmp_path) if one["ended"]]
    assert max(sum(begin <= moment < end for begin, end in spans) for moment, _ in spans) == 2
    assert not (out / ".g3r" / "slurm").exists()
    assert is_empty_soon()
    made = volumes(out)
    assert main(line) == 1
    assert len(events(tmp_path)) == 7
    assert volumes(out) == made


def test_tasks_that_slurm_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = data_set(tmp_path / "raw", {"01": b"image", "02": ENDLESS, "03": HUNGRY})
    use(tmp_path, monkeypatch)
    assert main([str(raw), str(tmp_path / "out"), "participant", *SLURM]) == 1
    table = rows(tmp_path / "out")
    assert {name: row["verdict"] for name, row in table.items()} == {
        "sub-01": "use", "sub-02": "failed", "sub-03": "failed"
    }  # fmt: skip
    assert "took longer than 1 min; pass --slurm ...,time=MINUTES" in table["sub-02"]["reasons"]
    assert "memory" in table["sub-03"]["reasons"]
    assert "mem=SIZE" in table["sub-03"]["reasons"]
    assert "Traceback" not in capsys.readouterr().err


def test_slurms_signal_comes_before_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process gets the stop request before the limit, and its log is complete."""
    monkeypatch.setattr("g3r.bids.slurm.SIGNAL_BEFORE_S", 90)
    raw = data_set(tmp_path / "raw", {"01": ENDLESS})
    use(tmp_path, monkeypatch)
    began_s = time.monotonic()
    assert main([str(raw), str(tmp_path / "out"), "participant", *SLURM]) == 1
    assert time.monotonic() - began_s < 55
    assert "took longer than 1 min" in rows(tmp_path / "out")["sub-01"]["reasons"]


def test_a_task_that_somebody_cancels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    raw, out = data_set(tmp_path / "raw", {"01": ENDLESS, "02": ENDLESS}), tmp_path / "out"
    use(tmp_path, monkeypatch)

    def cancel_all() -> None:
        until_s = time.monotonic() + 60
        while len(list((tmp_path / "events").iterdir())) < 2 and time.monotonic() < until_s:
            time.sleep(0.1)
        subprocess.run(["scancel", "--user=root"], check=True)

    somebody = threading.Thread(target=cancel_all)
    somebody.start()
    assert main([str(raw), str(out), "participant", *SLURM]) == 1
    somebody.join()
    assert all("was cancelled in Slurm" in row["reasons"] for row in rows(out).values())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_run_that_was_cut_short_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], number: signal.Signals
) -> None:
    raw = data_set(tmp_path / "raw", {"01": b"image", "02": ENDLESS, "03": b"image"})
    out = tmp_path / "out"
    command = use(tmp_path, monkeypatch)
    line = [str(raw), str(out), "participant", "--jobs", "2", *SLURM]
    code = f"import sys; from g3r.bids import cohort; cohort.INFER = {command!r}\n"
    code += f"from g3r.cli.bids import main; sys.exit(main({line!r}))"
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True) as run:
        until_s = time.monotonic() + 60
        while len(volumes(out)) < 2 and time.monotonic() < until_s:
            time.sleep(0.1)
        run.send_signal(number)
        _, said = run.communicate(timeout=60)
    assert "Traceback" not in said
    made = volumes(out)
    assert len(made) == 2
    if number == signal.SIGKILL:  # no process is left to cancel waiting tasks
        assert main(line) == 3
        said = capsys.readouterr().err
        assert "of an earlier run waits or runs" in said
        subprocess.run(["scancel", said.split("`scancel ")[1].split("`")[0]], check=True)
    assert is_empty_soon()
    (raw / "sub-02" / "anat" / "sub-02_run-1_T2w.nii.gz").write_bytes(b"mended")
    assert main(line) == 0
    assert len(volumes(out)) == 3
    assert made.items() <= volumes(out).items()


def test_what_slurm_refuses(tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    raw = data_set(tmp_path / "raw", {"01": b"image", "02": b"image"})
    use(tmp_path, monkeypatch)
    assert main([str(raw), str(tmp_path / "out"), "participant", "--slurm", "partition=nowhere"]) == 3
    said = capfd.readouterr().err.splitlines()
    assert len(said) == 1
    assert "no job was taken" in said[0]
    assert "invalid partition" in said[0]
