"""Ctrl-C at chosen moments: kept results and their marks; a second Ctrl-C ends the run at once."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g3r.acquisition.images import load_volume
from g3r.cli.interruption import ended_behind
from g3r.cli.terminal import Terminal
from g3r.gaussians import GaussianCloud
from g3r.output.record import RunRecord
from g3r.report.stage_words import WRITING
from tests.faults.small_case import WHOLE, SmallCase, names, quick_settings
from tests.quick import QUICK_FIT
from tests.tally import Tally

N_STEPS = QUICK_FIT.slice_stage.n_steps


@pytest.fixture
def interrupt_at(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Send a signal a given number of times when a stage reaches a step."""

    def choose(stage: str, step: int, number: signal.Signals = signal.SIGINT, times: int = 1) -> None:
        def progress(self: Terminal, name: str, done: int, total: int) -> None:
            if (name, done) == (stage, step):
                for _ in range(times):
                    signal.raise_signal(number)

        monkeypatch.setattr(Terminal, "progress", progress)

    return choose


def test_before_there_is_a_volume_nothing_is_written(
    case: SmallCase, interrupt_at: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str], tally: Tally
) -> None:
    with tally.case():
        interrupt_at("registration", 0)
        assert case.run(tmp_path / "deep" / "out") == 130
        assert capsys.readouterr().err.endswith("g3r-infer: interrupted; nothing was written\n")
        assert names(tmp_path) == set()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_in_the_fit_the_cloud_so_far_is_the_volume(
    case: SmallCase,
    interrupt_at: Callable[..., None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    tally: Tally,
    number: signal.Signals,
    code: int,
) -> None:
    with tally.case():
        out = tmp_path / "out"
        interrupt_at("fit to slices", 20, number)
        assert case.run(out) == code
        last = capsys.readouterr().err.splitlines()[-1]
        assert f"interrupted in fit to slices, step 21 of {N_STEPS}: {out} holds the volume so far" in last
        assert "--resume" in last
        assert names(out) == WHOLE - {"uncertainty.nii.gz"}
        record = json.loads((out / "run.json").read_text())
        assert record["partial"] is True
        assert record["stopped_at"] == {"stage": "fit to slices", "step": 21, "n_steps": N_STEPS}
        assert len(record["loss"]["fit to slices"]) == 21
        volume = load_volume(out / "volume.nii.gz").data
        (tmp_path / "whole.nii.gz").write_bytes(case.volume)
        whole = load_volume(tmp_path / "whole.nii.gz").data
        assert np.abs(volume - whole).max() > 0
        assert np.corrcoef(volume[whole > 0], whole[whole > 0])[0, 1] > 0.95
        # and resumed to the same end, replacing the partial result
        interrupt_at("nothing", 0)
        assert case.run(out, "--resume") == 0
        assert (out / "volume.nii.gz").read_bytes() == case.volume
        assert json.loads((out / "run.json").read_text())["resumed"] == [
            "registration",
            "coarse volume",
            "prior",
            "fit to prior",
        ]
        assert names(tmp_path) == {"out", "whole.nii.gz"}


def test_before_the_fit_to_slices_the_prior_is_the_volume(
    case: SmallCase, interrupt_at: Callable[..., None], tmp_path: Path, tally: Tally
) -> None:
    with tally.case():
        out = tmp_path / "out"
        interrupt_at("fit to prior", 3)
        assert case.run(out) == 130
        assert json.loads((out / "run.json").read_text())["stopped_at"]["stage"] == "fit to prior"
        volume, prior, mask = (load_volume(out / f"{name}.nii.gz").data for name in ("volume", "prior", "mask"))
        np.testing.assert_array_equal(volume[mask > 0], prior[mask > 0])
        assert (np.abs(volume) <= np.abs(prior)).all()  # the volume fades at its edge
        assert len(GaussianCloud.load(out / "gaussians.npz")) == 0


def test_a_partial_result_is_replaced_only_when_told(
    case: SmallCase, interrupt_at: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str], tally: Tally
) -> None:
    with tally.case() as one:
        interrupt_at("fit to slices", 5)
        assert case.run(tmp_path / "out") == 130
        assert case.run(tmp_path / "out") == 3
        assert "--force" in capsys.readouterr().err
        one.refused()


def test_a_second_signal_ends_at_once(
    case: SmallCase, interrupt_at: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str], tally: Tally
) -> None:
    with tally.case():
        interrupt_at("fit to slices", 5, times=2)
        assert case.run(tmp_path / "out") == 130
        assert "nothing was written; --resume goes on" in capsys.readouterr().err
        assert names(tmp_path) == {"out.unfinished"}
        interrupt_at("nothing", 0)
        assert case.run(tmp_path / "out", "--resume") == 0
        assert names(tmp_path) == {"out"}


def test_while_the_result_is_written_it_is_finished(
    case: SmallCase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tally: Tally
) -> None:
    """This also holds for a run without a fit, where no earlier stage postpones a stop."""
    record = RunRecord.read(case.config)
    config = tmp_path / "run.json"
    config.write_text(replace(record, settings=replace(record.settings, n_lattices=0)).to_json())
    begun = Terminal.begun

    def interrupted(self: Terminal, stage: str) -> None:
        begun(self, stage)
        if stage == WRITING:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Terminal, "begun", interrupted)
    with tally.case():
        out = tmp_path / "out"
        assert case.run(out, "--config", str(config)) == 130
        assert f"g3r-infer: interrupted at the end: the result in {out} is complete\n" in capsys.readouterr().err
        assert {"volume.nii.gz", "run.json", "report.html"} <= names(out)
        assert names(tmp_path) == {"out", "run.json"}


@pytest.mark.parametrize("where", ["g3r.cli.infer.write_dicom", "g3r.run.log_file.LogFile.go_on_in"])
def test_a_second_signal_when_the_result_is_in_place_says_so(
    case: SmallCase,
    where: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tally: Tally,
) -> None:
    def interrupted(*arguments: object) -> None:
        for _ in range(2):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(where, interrupted)
    with tally.case():
        out = tmp_path / "out"
        assert case.run(out) == 130
        last = capsys.readouterr().err.splitlines()[-1]
        assert last == f"g3r-infer: interrupted; the result in {out} is complete"
        assert names(out) == WHOLE


def test_what_is_said_of_a_result_that_is_in_place(tmp_path: Path) -> None:
    record = RunRecord(settings=quick_settings(), stacks=[])
    (tmp_path / "run.json").write_text(record.to_json())
    whole = f"interrupted; the result in {tmp_path} is complete"
    assert ended_behind(tmp_path, None) == whole
    assert ended_behind(tmp_path, str(tmp_path / "series")) == f"{whole}; --dicom-out was not written"
    (tmp_path / "series").mkdir()
    (tmp_path / "series" / "0001.dcm").write_text("")
    assert ended_behind(tmp_path, str(tmp_path / "series")) == whole
    (tmp_path / "run.json").write_text(replace(record, partial=True).to_json())
    assert "marked as partial" in ended_behind(tmp_path, None)


def test_signals_are_handled_as_before_afterwards(
    case: SmallCase, interrupt_at: Callable[..., None], tmp_path: Path
) -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    interrupt_at("fit to slices", 5)
    case.run(tmp_path / "out")
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
