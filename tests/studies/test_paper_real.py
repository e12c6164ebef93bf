"""Study of real stacks, with a small phantom in their place: each stack is left out and predicted."""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from g3r.errors import InputError
from studies.harness import DOCS, Record
from studies.paper.real import METHODS, STUDY, finish, line, measure, subjects, tables, tasks


def options(subject: Path, *more: str) -> argparse.Namespace:
    """Two stacks, and the third as a repeat."""
    words = ["--thickness", "4", "--preset", "preview", *more]
    for option, name, numbers in (
        ("--stacks", "stack", (0, 1)),
        ("--masks", "mask", (0, 1)),
        ("--held-out", "stack", (2,)),
        ("--held-out-mask", "mask", (2,)),
    ):
        words += [option, *(str(subject / f"{name}-{n}.nii.gz") for n in numbers)]
    return STUDY.parser().parse_args(words)


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("real")


@pytest.fixture(scope="module")
def record(subject: Path, output: Path) -> Record:
    """Record of the repeat, predicted from both stacks."""
    given = options(subject, "--output", str(output))
    (task,) = [task for task in tasks(given) if task.key == "subject 1 of all stacks"]
    machine = {"processor": "a", "cores": 1, "threads": 1, "python": "3", "torch": "2", "numba": "0"}
    return {
        "preset": "preview",
        "weights": "0",
        "threads": 1,
        "eroded_pixels": 1,
        "machine": machine | {"g3r": "0", "commit": "abc1234"},
        "rows": {task.key: measure(*task.arguments)},
    }


def test_every_stack_is_left_out_once(subject: Path) -> None:
    keys = [task.key for task in tasks(options(subject))]
    assert keys == ["subject 1 without stack 1", "subject 1 without stack 2", "subject 1 of all stacks"]


def test_every_method_predicts_the_same_pixels(record: Record) -> None:
    ((key, row),) = record["rows"].items()
    scores = row["scores"]["repeat 1"]
    assert set(scores) == set(METHODS)
    counted = [one["counted_share"] for one in scores.values()]
    assert max(counted) - min(counted) < 0.1
    assert all(one["ncc"] > 0.7 for one in scores.values())
    assert scores["g3r"]["psnr_db"] > scores["V_coarse"]["psnr_db"]
    assert "repeat 1 predicted by g3r" in line(key, row)


def test_the_table_names_no_file(record: Record, subject: Path) -> None:
    text = tables(record)["paper-real"]
    assert "subjects: 1, held-out stacks: 1" in text
    assert "commit abc1234" in text
    assert "| subject 1, repeat 1 | 2 stacks |" in text
    assert "nii" not in text
    assert subject.name not in text.replace("subject 1", "").replace("subjects: 1", "")
    assert tables(record | {"rows": {}}) == {"paper-real": "Not measured yet."}


def test_the_picture_goes_where_it_is_asked_for_alone(
    record: Record, subject: Path, output: Path, tmp_path: Path
) -> None:
    picture = tmp_path / "real.png"
    finish(record, options(subject, "--output", str(output)))
    assert not picture.exists()
    finish(record, options(subject, "--output", str(output), "--picture", str(picture)))
    drawn = matplotlib.image.imread(picture)
    assert drawn.shape[0] > 400
    assert np.ptp(drawn) > 0.9
    for more, message in (
        (["--picture", str(DOCS / "images" / "real.png")], "do not belong in docs"),
        (["--picture", str(picture), "--picture-of", "2"], "expected 1 to 1"),
        (["--picture", str(picture), "--output", str(tmp_path)], "measure again"),
    ):
        with pytest.raises(InputError, match=message):
            finish(record, options(subject, "--output", str(output), *more))


def test_what_cannot_be_measured_is_refused(subject: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = options(subject)
    given.masks = given.masks[:1]
    with pytest.raises(InputError, match="2 stacks, 1 masks"):
        subjects(given)
    with pytest.raises(InputError, match="stacks that are free"):
        subjects(options(subject, "--publish"))
    monkeypatch.setenv("G3R_TEST_DATA", str(tmp_path))
    with pytest.raises(InputError, match="G3R_TEST_DATA"):
        subjects(STUDY.parser().parse_args([]))
