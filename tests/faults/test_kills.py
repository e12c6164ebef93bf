"""kill -9, SIGTERM and Ctrl-C at random moments: the result is complete, absent, or marked as partial."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g3r.acquisition.images import load_volume
from tests.faults.small_case import WHOLE, Killed, SmallCase, names
from tests.tally import Tally

N_KILLS, N_SIGNALS = 24, 12


def is_whole(folder: Path, case: SmallCase) -> bool:
    return names(folder) == WHOLE and (folder / "volume.nii.gz").read_bytes() == case.volume


def moments(n: int, killed: Killed, case: SmallCase, folder: Path, seed: int) -> list[float]:
    """Random moments of a run, twice as dense in its last fifth, when files are written."""
    whole = min(killed(case.arguments(folder / f"timed-{k}"))["seconds"] for k in range(2))
    shutil.rmtree(folder / "timed-0")
    shutil.rmtree(folder / "timed-1")
    share = (np.arange(n) + np.random.default_rng(seed).uniform(0, 1, n)) / n * 1.2
    return (whole * np.where(share < 0.8, share, 0.8 + (share - 0.8) / 2)).tolist()


@pytest.mark.faults
def test_kill_9_leaves_a_whole_result_or_none_and_the_next_run_clears_up(
    case: SmallCase, killed: Killed, tmp_path: Path, tally: Tally
) -> None:
    out, resumed = tmp_path / "out", 0
    for number, moment in enumerate(moments(N_KILLS, killed, case, tmp_path, 1)):
        with tally.case():
            ended = killed(case.arguments(out), kill_after_s=moment)
            assert ended["code"] in (-signal.SIGKILL, 0), ended
            if out.exists():
                assert is_whole(out, case)
            assert names(tmp_path) <= {"out", "out.unfinished"}
            if ended["code"] == 0:
                assert names(tmp_path) == {"out"}
            if not out.exists():
                again = killed(case.arguments(out, *(["--resume"] if number % 4 else [])))
                assert again["code"] == 0, again
                assert "Traceback" not in again["output"]
                assert is_whole(out, case)
                resumed += bool(json.loads((out / "run.json").read_text())["resumed"])
            elif names(tmp_path) != {"out"}:  # killed between the last two renames
                assert killed(case.arguments(out, "--force"))["code"] == 0
            assert names(tmp_path) == {"out"}
            shutil.rmtree(out)
    assert resumed > 0


@pytest.mark.faults
def test_kill_9_while_a_result_is_replaced_leaves_the_old_or_the_new_one(
    case: SmallCase, killed: Killed, tmp_path: Path, tally: Tally
) -> None:
    out = tmp_path / "out"
    for moment in moments(N_KILLS // 3, killed, case, tmp_path, 2):
        with tally.case():
            out.mkdir(exist_ok=True)
            (out / "volume.nii.gz").write_text("old")
            (out / "prior_share.nii.gz").write_text("old")
            (out / "notes.txt").write_text("mine")
            killed(case.arguments(out, "--force"), kill_after_s=moment)
            if out.exists() and (out / "volume.nii.gz").read_bytes() != case.volume:
                assert names(out) == {"volume.nii.gz", "prior_share.nii.gz", "notes.txt"}
            assert killed(case.arguments(out, "--force"))["code"] == 0
            assert names(out) == WHOLE | {"notes.txt"}
            assert is_whole_but_for_notes(out, case)
            assert names(tmp_path) == {"out"}
            shutil.rmtree(out)


def is_whole_but_for_notes(folder: Path, case: SmallCase) -> bool:
    own = (folder / "notes.txt").read_text() == "mine"
    return own and (folder / "volume.nii.gz").read_bytes() == case.volume


@pytest.mark.faults
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_at_any_moment_gives_nothing_a_marked_volume_or_the_whole(
    case: SmallCase, killed: Killed, tmp_path: Path, tally: Tally, number: signal.Signals, code: int
) -> None:
    out = tmp_path / "out"
    for moment in moments(N_SIGNALS // 2, killed, case, tmp_path, 3):
        with tally.case():
            ended = killed(case.arguments(out), kill_after_s=moment, signal=number)
            check_interrupted(ended, out, case, code)
            again = killed(case.arguments(out, "--resume", "--force"))
            assert again["code"] == 0, again
            assert is_whole(out, case)
            assert names(tmp_path) == {"out"}
            shutil.rmtree(out)


def check_interrupted(ended: dict[str, Any], out: Path, case: SmallCase, code: int) -> None:
    """Assert the state after a first signal, as named by the test."""
    assert "Traceback" not in ended["output"], ended
    if ended["code"] in (0, -signal.SIGTERM) or (ended["code"] == 130 and "interrupted" not in ended["output"]):
        # before the command handled signals (it had just begun), or after everything was done
        assert not out.exists() or is_whole(out, case)
        return
    assert ended["code"] == code, ended
    if not out.exists():
        assert "nothing was written" in ended["output"]
        return
    record = json.loads((out / "run.json").read_text())
    if record["partial"]:
        assert names(out) == WHOLE - {"uncertainty.nii.gz"}
        assert np.isfinite(load_volume(out / "volume.nii.gz").data).all()
    else:
        assert is_whole(out, case)
