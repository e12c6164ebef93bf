"""Many sessions with a stand-in for g3r-infer: results, repeated runs, failures."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from g3r.bids import cohort
from g3r.bids.dataset import Session
from g3r.cli.bids import main
from tests.bids.cohorts import rows, volumes
from tests.bids.data_sets import BROKEN, add_session, ready_result, stand_in

N = 6

Use = Callable[..., tuple[str, ...]]


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """Six participants with masks, the fourth broken."""
    for n in range(1, N + 1):
        stacks = [(f"run-{k}", BROKEN if n == 4 else b"image", b"mask") for k in (1, 2)]
        add_session(tmp_path / "raw", f"0{n}", "1" if n % 2 else None, stacks)
    return tmp_path / "raw"


@pytest.fixture
def use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Use:
    """Use the stand-in instead of g3r-infer."""
    result = ready_result(tmp_path / "ready")

    def put(seconds: float = 0.0) -> tuple[str, ...]:
        command = stand_in(result, tmp_path / "events", seconds)
        monkeypatch.setattr(cohort, "INFER", command)
        return command

    return put


def events(tmp_path: Path) -> list[dict[str, Any]]:
    return [json.loads(path.read_text()) for path in sorted((tmp_path / "events").iterdir())]


def test_one_bad_subject_stops_nobody_and_what_is_done_stays(
    raw: Path, use: Use, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    use()
    out = tmp_path / "out"
    line = [str(raw), str(out), "participant", "--jobs", "2"]
    assert main(line) == 1
    made = volumes(out)
    assert len(made) == N - 1
    table = rows(out)
    assert table["sub-04"]["verdict"] == "failed"
    assert table["sub-04"]["reasons"].startswith("sub-04_run-1_T2w.nii.gz: not a readable NIfTI file")
    assert table["sub-01"] | {"seconds": ""} == {
        "participant_id": "sub-01", "session_id": "ses-1", "verdict": "use", "seconds": "", "stacks": "1",
        "slices_used": "7", "slices": "9", "unseen_share": "0.0125", "reasons": "3 of 3 stacks agree with each other"
    }  # fmt: skip
    assert table["sub-01"]["seconds"] == "3.5"
    assert "4 use" not in capsys.readouterr().err
    assert not list(out.glob(".g3r/sub-01*"))
    assert "not a readable" in (out / "logs" / "g3r-sub-04.log").read_text()

    assert main(line) == 1  # only the broken one is tried
    assert volumes(out) == made
    assert len(events(tmp_path)) == N + 1
    for path in (raw / "sub-04").rglob("*_T2w.nii.gz"):
        path.write_bytes(b"mended")
    assert main([str(raw), str(out), "group"]) == 1
    assert main(line) == 0
    assert len(volumes(out)) == N
    assert made.items() <= volumes(out).items()
    assert main([str(raw), str(out), "group"]) == 0
    assert rows(out)["sub-04"]["verdict"] == "use"


def test_force_replaces_and_keeps_what_others_put_there(raw: Path, use: Use, tmp_path: Path) -> None:
    use()
    out = tmp_path / "out"
    line = [str(raw), str(out), "participant", "--participant-label", "01", "sub-02"]
    assert main(line) == 0
    made = volumes(out)
    assert len(made) == 2
    other = out / "sub-01" / "ses-1" / "anat" / "sub-01_ses-1_rec-g3r_dseg.nii.gz"
    other.write_bytes(b"of another tool")
    assert main([*line, "--force"]) == 0
    again = volumes(out)
    assert all(again[name] > made[name] for name in made)
    assert other.read_bytes() == b"of another tool"
    assert rows(out)["sub-03"]["verdict"] == "not run"


def test_never_more_processes_than_jobs(raw: Path, use: Use, tmp_path: Path) -> None:
    use(0.3)
    assert main([str(raw), str(tmp_path / "out"), "participant", "--jobs", "2"]) == 1
    spans = [(one["began"], one["ended"]) for one in events(tmp_path) if one["ended"]]
    assert len(spans) == N - 1
    at_once = [sum(begin <= moment < end for begin, end in spans) for moment, _ in spans]
    assert max(at_once) == 2


def has_ended(process: psutil.Process, within_s: float = 10.0) -> bool:
    """Whether a process ends in time; a zombie counts as ended."""
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        with contextlib.suppress(psutil.NoSuchProcess):
            if process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
                time.sleep(0.02)
                continue
        return True
    return False


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_run_that_was_cut_short_goes_on(raw: Path, use: Use, tmp_path: Path, number: signal.Signals) -> None:
    """Its child processes end with it, and finished sessions are not repeated."""
    command, out = use(1.0), tmp_path / "out"
    line = [str(raw), str(out), "participant", "--jobs", "2"]
    code = f"import sys; from g3r.bids import cohort; cohort.INFER = {command!r}\n"
    code += f"from g3r.cli.bids import main; sys.exit(main({line!r}))"
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True) as run:
        until = time.monotonic() + 60
        while not volumes(out) and time.monotonic() < until:
            time.sleep(0.02)
        time.sleep(0.2)
        children = psutil.Process(run.pid).children()
        assert 1 <= len(children) <= 2
        run.send_signal(number)
        if number == signal.SIGKILL:  # no process is left to end the children
            for child in children:
                child.kill()
        _, said = run.communicate(timeout=60)
        assert run.returncode == {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}[number]
        assert all(has_ended(child) for child in children)
        assert "Traceback" not in said
    if number != signal.SIGKILL:
        assert said == "g3r-bids: interrupted; what was done stays, and the same command goes on\n"
        assert "not run" in {row["verdict"] for row in rows(out).values()}
    made = volumes(out)
    assert 1 <= len(made) < N - 1
    use()
    assert main(line) == 1
    assert len(volumes(out)) == N - 1
    assert made.items() <= volumes(out).items()


def test_a_result_that_only_lacks_its_derivative_is_not_computed_again(raw: Path, use: Use, tmp_path: Path) -> None:
    use()
    out = tmp_path / "out"
    line = [str(raw), str(out), "participant", "--participant-label", "01", "--keep-work"]
    assert main(line) == 0
    assert (out / ".g3r" / "sub-01_ses-1" / "result" / "volume.nii.gz").exists()
    (out / "sub-01" / "ses-1" / "anat" / "sub-01_ses-1_rec-g3r_run.json").unlink()
    assert main(line) == 0
    assert len(events(tmp_path)) == 1
    assert len(volumes(out)) == 1


def test_what_each_process_is_told(raw: Path, use: Use, tmp_path: Path) -> None:
    use()
    mask = next((raw / "derivatives").rglob("sub-03*run-2*"))
    mask.unlink()
    line = [str(raw), str(tmp_path / "out"), "participant", "--participant-label", "03"]
    assert main([*line, "--jobs", "1", "--", "--preset", "fast", "--threads", "1"]) == 0
    (event,) = events(tmp_path)
    words = event["words"]
    masks = words[words.index("--masks") + 1 :][:2]
    assert masks[0].endswith("sub-03_ses-1_run-1_desc-brain_mask.nii.gz")
    assert masks[1] == "auto"
    assert "--resume" in words
    assert words.count("--threads") == 1
    assert main([*line, "--force", "--", "--time-budget", "30", "--whole-image"]) == 0
    words = events(tmp_path)[-1]["words"]
    assert not {"--masks", "--resume"} & set(words)


@pytest.mark.parametrize("budget", [None, {"seconds": 30.0}])
def test_the_repetition_of_a_budget_is_not_resumed(
    raw: Path, use: Use, tmp_path: Path, budget: dict[str, float] | None
) -> None:
    """Such a run keeps no stages, and g3r-infer would refuse --resume."""
    use()
    config = tmp_path / "run.json"
    config.write_text(json.dumps({"time_budget": budget}))
    line = [str(raw), str(tmp_path / "out"), "participant", "--participant-label", "03", "--", "--config", str(config)]
    assert main(line) == 0
    assert ("--resume" in events(tmp_path)[0]["words"]) is (budget is None)


def test_a_failed_try_to_replace_a_result_is_tried_again(raw: Path, use: Use, tmp_path: Path) -> None:
    """The old volume is not passed off as the new one."""
    use()
    line = [str(raw), str(tmp_path / "out"), "participant", "--participant-label", "03"]
    assert main(line) == 0
    first = next((raw / "sub-03").rglob("*run-1_T2w.nii.gz"))
    first.write_bytes(BROKEN)
    assert main([*line, "--force"]) == 1
    assert rows(tmp_path / "out")["sub-03"]["verdict"] == "failed"
    first.write_bytes(b"mended")
    assert main(line) == 0
    assert len(events(tmp_path)) == 3
    assert rows(tmp_path / "out")["sub-03"]["verdict"] == "use"


@pytest.mark.parametrize(
    ("code", "reason"),
    [(1, "ValueError: x"), (3, "a.nii.gz: thickness is taken as the distance of slices"), (None, "ValueError: x")],
)
def test_the_reason_of_a_defect_is_its_last_line(tmp_path: Path, code: int | None, reason: str) -> None:
    log = tmp_path / "log"
    lines = ["g3r-infer --stacks a.nii.gz", "g3r-infer: a.nii.gz: thickness is taken as the distance of slices"]
    if code != 3:
        lines += ["Traceback (most recent call last):", "ValueError: x"]
    log.write_text("\n".join(lines) + "\n")
    assert cohort._reason(log, code or 1) == reason


def test_neither_command_lines_nor_reasons_name_folders(raw: Path, use: Use, tmp_path: Path) -> None:
    """A data set is passed on. What a process prints in its log is its own affair."""
    use()
    out, link = tmp_path / "out", next((raw / "sub-03").rglob("*run-1_T2w.nii.gz"))
    link.unlink()
    link.symlink_to(tmp_path / "not-fetched" / "image")
    (tmp_path / "JANE").mkdir()
    assert main([str(raw.rename(tmp_path / "JANE" / "raw")), str(out), "participant"]) == 1
    assert "T2w.nii.gz" in rows(out)["sub-03"]["reasons"]
    logs = list((out / "logs").glob("*.log"))
    assert len(logs) == N
    told = [path.read_text() for path in (*out.glob("*.tsv"), *out.glob("*.html"), *out.rglob("*.failure.json"))]
    told += [path.read_text().splitlines()[0] for path in logs]
    assert len(told) == N + 4
    assert not any("JANE" in text or str(tmp_path) in text for text in told)


def test_an_interrupted_session_keeps_its_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its stages can only be used with as many, and how many there are follows the memory that is free."""
    monkeypatch.setattr(cohort, "available_cores", lambda: 4)
    session = Session(participant="01", session=None, stacks=())
    work = cohort.Work(session=session, inputs=(), words=("infer", "--resume"), folder=tmp_path)
    assert work.with_threads(2, as_before=True).words[-2:] == ("--threads", "2")
    work.note.write_text(json.dumps([*work.words, "--threads", "4"]))
    assert work.with_threads(2, as_before=True).words[-1] == "4"
    assert work.with_threads(2, as_before=False).words[-1] == "2"
    monkeypatch.setattr(cohort, "available_cores", lambda: 3)
    assert work.with_threads(2, as_before=True).words[-1] == "2"
    monkeypatch.setattr(cohort, "available_cores", lambda: 4)
    other = cohort.Work(session=session, inputs=(), words=("infer", "--preset", "fast"), folder=tmp_path)
    assert other.with_threads(2, as_before=True).words[-1] == "2"


def test_a_session_without_a_stack_is_in_the_table(
    raw: Path, use: Use, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use()
    (raw / "sub-04").rename(tmp_path / "sub-04")
    anat = add_session(raw, "07", None, [("rec-other", b"x", None)])
    assert anat.is_dir()
    monkeypatch.chdir(tmp_path)
    raw.rename(tmp_path / "-raw")
    assert main(["./-raw", "out", "participant"]) == 0
    row = rows(tmp_path / "out")["sub-07"]
    assert (row["verdict"], row["reasons"]) == ("no stack", "not read: sub-07_rec-other_T2w.nii.gz")
    assert len(volumes(tmp_path / "out")) == N - 1
    words = events(tmp_path)[0]["words"]
    assert Path(words[words.index("--stacks") + 1]).is_absolute()
