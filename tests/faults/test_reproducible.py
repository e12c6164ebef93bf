"""Same seed, machine and threads give the same bytes, and run.json is enough to repeat a run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from g3r.cli.infer import main as infer
from g3r.errors import InputError
from g3r.output.record import RunRecord
from g3r.run.provenance import FileHash
from tests.faults.small_case import SmallCase
from tests.tally import Tally

SAME = ("volume.nii.gz", "mask.nii.gz", "uncertainty.nii.gz", "gaussians.npz", "slices.tsv", "sections.png")
QUICK = ("--preset", "fast", "--resolution", "2", "--thickness", "4")


def same_files(one: Path, other: Path) -> bool:
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in SAME)


def test_the_same_bytes_again_and_in_another_process(case: SmallCase, tmp_path: Path, tally: Tally) -> None:
    with tally.case():
        assert case.run(tmp_path / "one") == 0
        line = [sys.executable, "-m", "g3r.cli.infer", *case.arguments(tmp_path / "two")]
        done = subprocess.run(
            line, check=False, capture_output=True, text=True, env=os.environ | {"PYTHONHASHSEED": "7"}
        )
        assert done.returncode == 0, done.stderr
        assert same_files(tmp_path / "one", tmp_path / "two")


@pytest.mark.faults
@pytest.mark.parametrize(("threads", "further"), [("1", ("--no-prior",)), ("2", ("--space", "scanner", "--seed", "5"))])
def test_options_then_config_then_config_of_that(
    case: SmallCase, tmp_path: Path, tally: Tally, threads: str, further: tuple[str, ...]
) -> None:
    """With the whole registration, with and without the prior network, each run in its own process."""
    if int(threads) > int(numba.config.NUMBA_NUM_THREADS):  # type: ignore[attr-defined]
        pytest.skip("a machine of one core")
    files = ["--stacks", *case.files("stack"), "--masks", *case.files("mask"), "--quiet"]
    runs = {
        "options": [*QUICK, *further, "--threads", threads],
        "config": ["--config", str(tmp_path / "options" / "run.json")],
        "again": ["--config", str(tmp_path / "config" / "run.json")],
    }
    with tally.case():
        for name, options in runs.items():
            line = [sys.executable, "-m", "g3r.cli.infer", *files, *options, "--output", str(tmp_path / name)]
            done = subprocess.run(line, check=False, capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
            assert "will be another" not in done.stderr
            assert same_files(tmp_path / "options", tmp_path / name)


@pytest.mark.faults
@pytest.mark.parametrize("seconds", [1.0, 8.0])
def test_a_run_with_a_time_budget_can_be_run_again_without_its_clock(
    case: SmallCase, tmp_path: Path, tally: Tally, seconds: float
) -> None:
    """The loops stop at the same steps, whose fractions are recorded in run.json."""
    files = ["--stacks", *case.files("stack"), "--masks", *case.files("mask"), "--quiet", "--threads", "1"]
    options = ["--no-prior", "--resolution", "2", "--thickness", "4", "--time-budget", str(seconds)]
    with tally.case():
        assert infer([*files, *options, "--output", str(tmp_path / "first")]) == 0
        record = RunRecord.read(tmp_path / "first" / "run.json")
        assert record.time_budget is not None
        assert len(record.loss["fit to slices"]) == len(record.time_budget.loops[-1])
        again = ["--config", str(tmp_path / "first" / "run.json"), "--output", str(tmp_path / "again")]
        assert infer([*files, *again]) == 0
        assert same_files(tmp_path / "first", tmp_path / "again")


def test_run_json_says_what_is_needed_and_no_paths(case: SmallCase, tmp_path: Path) -> None:
    assert case.run(tmp_path / "out") == 0
    text = (tmp_path / "out" / "run.json").read_text()
    assert str(case.folder) not in text
    assert str(tmp_path) not in text
    run = RunRecord.read(tmp_path / "out" / "run.json")
    assert run.settings == RunRecord.read(case.config).settings
    assert run.inputs is not None
    assert run.inputs.stacks == tuple(map(FileHash.of, case.files("stack")))
    assert run.command is not None
    assert (run.command.threads, run.time_budget) == (1, None)
    assert [stack.thickness_mm for stack in run.stacks] == [4.0, 4.0, 4.0]
    assert RunRecord.from_json(run.to_json()) == run


def test_other_inputs_are_told_and_noted(
    case: SmallCase, tmp_path: Path, caplog: pytest.LogCaptureFixture, tally: Tally
) -> None:
    with tally.case():
        stacks = case.files("stack")
        arguments = case.arguments(tmp_path / "out")
        swapped = [{stacks[0]: stacks[1], stacks[1]: stacks[0]}.get(one, one) for one in arguments]
        swapped = [one.replace("mask-1", "mask-x").replace("mask-0", "mask-1") for one in swapped]
        swapped = [one.replace("mask-x", "mask-0") for one in swapped]
        assert infer(swapped) == 0
        expected = "stack 1 (stack-1.nii.gz) is not the file that the configuration's result was made of"
        assert expected in caplog.text
        warnings = RunRecord.read(tmp_path / "out" / "run.json").warnings
        assert any(expected in line for line in warnings)


@pytest.mark.parametrize(
    "options",
    [
        ["--preset", "fast"],
        ["--seed", "0"],
        ["--no-prior"],
        ["--resolution", "1"],
        ["--time-budget", "9"],
        ["--space", "scanner"],
    ],
)
def test_options_that_the_config_decides_are_refused(
    case: SmallCase, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        case.run(tmp_path / "out", *options)
    assert caught.value.code == 2
    assert f"--config and {options[0]} exclude each other" in capsys.readouterr().err


def spoilt(text: str) -> dict[str, str]:
    """Contents that are not a valid run.json, by their fault."""
    record = json.loads(text)
    other = {**record, "settings": {**record["settings"], "surprise": 1}}
    wrong = {**record, "settings": {**record["settings"], "seed": "five"}}
    return {
        "cut off": text[:200],
        "empty": "",
        "not json": "hello",
        "a list": "[]",
        "a number": "3",
        "nested": "[" * 100_000,
        "without settings": json.dumps({"partial": False}),
        "partial": json.dumps({**record, "partial": True}),
        "another setting": json.dumps(other),
        "a word for a number": json.dumps(wrong),
        "settings that are a list": json.dumps({**record, "settings": []}),
    }


def test_a_bad_config_is_refused_in_one_line(
    case: SmallCase, tmp_path: Path, capsys: pytest.CaptureFixture[str], tally: Tally
) -> None:
    path = tmp_path / "bad.json"
    for what, text in spoilt(case.config.read_text()).items():
        with tally.case() as one:
            path.write_text(text)
            assert SmallCase(case.folder, path, b"").run(tmp_path / "out") == 3, what
            said = capsys.readouterr().err
            assert said.count("\n") == 1, said
            one.refused()
    assert not (tmp_path / "out").exists()


def test_files_are_told_by_their_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert FileHash.of(tmp_path / "a") == FileHash("a", known)
    with pytest.raises(InputError, match="absent: cannot be read"):
        FileHash.of(tmp_path / "absent")


def test_fractions_of_the_pace_survive_json() -> None:
    values = np.random.default_rng(0).uniform(size=1000).tolist()
    assert json.loads(json.dumps(values)) == values
