"""`g3r-bids`: refusals before it starts any process."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from g3r.cli.bids import main
from tests.bids.data_sets import add_session


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    add_session(tmp_path / "raw", "01", None, [("run-1", b"image", b"mask")])
    return tmp_path / "raw"


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str]:
    try:
        code = main([str(word) for word in words])
    except SystemExit as end:
        code = int(end.code or 0)
    said = capsys.readouterr()
    assert said.out == ""
    assert "Traceback" not in said.err
    return code, said.err.splitlines()[-1]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--jobs", "0"], "--jobs 0; expected at least 1"),
        (["--", "--output", "there"], "--output after --: g3r-bids decides that"),
        (["--", "--stacks", "a", "b"], "--stacks after --"),
        (["--", "--masks", "a"], "--masks after --"),
        (["--", "--dicom-out", "D", "--dicom-reference", "PAT_A"], "--dicom-out, --dicom-reference after --"),
        (["--", "--force", "--dry-run"], "--force, --dry-run after --"),
        (["--", "--seed", "-1"], "--seed -1"),
        (["--", "--preset", "none"], "invalid choice"),
    ],
)
def test_options_that_cannot_be(
    raw: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    code, line = refused(capsys, raw, tmp_path / "out", "participant", *words)
    assert code == 2
    assert says in line
    assert not (tmp_path / "out").exists()


def test_folders_that_cannot_be(raw: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, line = refused(capsys, tmp_path / "nothing", tmp_path / "out", "participant")
    assert (code, "is no folder; expected a BIDS data set" in line) == (3, True)
    code, line = refused(capsys, raw, raw, "participant")
    assert (code, "is the input, too" in line) == (3, True)
    before = (raw / "dataset_description.json").read_text()
    other = tmp_path / "other"
    add_session(other, "09", None, [("run-1", b"image", None)])
    code, line = refused(capsys, raw, other, "participant")
    assert (code, "g3r did not make" in line) == (3, True)
    (other / "dataset_description.json").write_text("{")
    assert "is not JSON" in refused(capsys, raw, other, "participant")[1]
    (other / "dataset_description.json").unlink()
    assert "holds sub-*" in refused(capsys, raw, other, "participant")[1]
    (tmp_path / "file").write_text("")
    assert "is a file" in refused(capsys, raw, tmp_path / "file", "participant")[1]
    assert (raw / "dataset_description.json").read_text() == before
    code, line = refused(capsys, raw, tmp_path / "out", "participant", "--participant-label", "07")
    assert (code, "has no sub-07; found sub-01" in line) == (3, True)


@pytest.mark.parametrize("end", ["", "/", "/../raw/."])
def test_the_description_names_no_folder_above(raw: Path, tmp_path: Path, end: str) -> None:
    """For any way of writing paths, including those for g3r-infer; other words are unchanged."""
    out, secret = tmp_path / "out", "/data/secret/of study"
    words = ["group", "--slurm", f"partition=a,container={secret}/x", f"--mask-derivative={secret}/m"]
    infer = ["--preset", "fast", "--mask-command", f"{secret}/tool {{stack}} {{mask}}", f"--ckpt={secret}/prior.st"]
    infer += ["--pose-ckpt", f"{secret}/pose.st"]
    assert main([f"{raw}{end}", f"{out}/", *words, "--", *infer]) == 0
    text = (out / "dataset_description.json").read_text()
    assert not [word for word in ("secret", "study", tmp_path.name) if word in text]
    assert "Command: g3r-bids raw out group" in text
    assert "-- --preset fast --mask-command 'tool {stack} {mask}' --ckpt=prior.st --pose-ckpt pose.st" in text


def test_here_is_named_by_its_name(raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(raw)
    assert main([".", "../out", "group"]) == 0
    assert "Command: g3r-bids raw out group" in (tmp_path / "out" / "dataset_description.json").read_text()


def test_group_without_a_run_writes_the_table(raw: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(raw), str(tmp_path / "out"), "group"]) == 0
    assert "1 not run" in capsys.readouterr().out
    rows = (tmp_path / "out" / "participants_g3r.tsv").read_text().splitlines()
    assert rows[1].split("\t")[:3] == ["sub-01", "n/a", "not run"]
    described = json.loads((tmp_path / "out" / "participants_g3r.json").read_text())
    assert list(described) == rows[0].split("\t")
