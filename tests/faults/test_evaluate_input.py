"""`g3r-evaluate` with bad files: one line of error, never a traceback."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from g3r.cli import evaluate
from tests.faults.bad_files import BAD_MASKS, BAD_STACKS, USABLE_AS_A_VOLUME
from tests.faults.commands import Outcome, assert_refused, run
from tests.faults.nifti_files import ball, image, write
from tests.tally import Tally


def judged(outcome: Outcome, command: str, bad: Path, says: str, *, must: bool) -> bool:
    """Whether a command refused its input; asserts that a refusal is proper, and required if `must`."""
    if must or outcome.code:
        assert_refused(outcome, command, bad.name.replace("\0", "\\x00") if must else "", says if must else "")
        return True
    return False


VALID_MASKS = {"constant", "a mask", "all infinite", "slope beyond float32"}
"""Invalid stacks that are valid masks, because all or some of their voxels have one value above a half."""

NO_MASK = "mask is empty; expected|as an image does; expected|; resample the mask"
"""Message for readable images that are not masks; for the others it is the message for a stack."""


@pytest.mark.parametrize("name", BAD_STACKS)
@pytest.mark.parametrize("role", ["volume", "reference", "mask"])
def test_evaluate_refuses_a_bad_file_or_gives_finite_scores(role: str, name: str, tmp_path: Path, tally: Tally) -> None:
    make, says = BAD_STACKS[name]
    files = {"volume": write(tmp_path / "v.nii"), "reference": write(tmp_path / "r.nii", image(1))}
    files["mask"] = write(tmp_path / "m.nii", ball())
    (tmp_path / "bad files").mkdir()
    files[role] = make(tmp_path / "bad files")
    with tally.case() as case:
        line = [f"--{key}={path}" for key, path in files.items()]
        outcome = run(evaluate.main, [*line, "--json", tmp_path / "s.json"], tmp_path)
        must = name not in USABLE_AS_A_VOLUME and says != "no positive value"
        if role == "mask":
            must, says = name not in VALID_MASKS, f"{says}|{NO_MASK}"
        if judged(outcome, "g3r-evaluate", files[role], says, must=must):
            case.refused()
        else:
            assert outcome.changed == {str(tmp_path / "s.json")}
            scores = json.loads((tmp_path / "s.json").read_text())
            assert np.isfinite(list(scores.values())).all(), scores
            assert scores["n_voxels"] > 0


@pytest.mark.parametrize("name", BAD_MASKS)
def test_evaluate_with_a_bad_mask(name: str, tmp_path: Path, tally: Tally) -> None:
    make, says = BAD_MASKS[name]
    reference = write(tmp_path / "stack.nii.gz", image(1))
    (tmp_path / "masks").mkdir()
    bad = make(tmp_path / "masks")
    with tally.case() as case:
        line = ["--volume", write(tmp_path / "v.nii"), "--reference", reference, "--mask", bad]
        outcome = run(evaluate.main, line, tmp_path)
        if judged(outcome, "g3r-evaluate", bad, says, must="12 masked" not in says):
            case.refused()


TABLES = {
    "missing": None,
    "empty": b"",
    "no columns": b"a\tb\n1\t2\n",
    "binary": bytes(range(256)),
    "text for a number": b"stack\tslice\trx\try\trz\ttx\tty\ttz\n0\tx\t0\t0\t0\t0\t0\t0\n",
    "NaN": b"stack\tslice\trx\try\trz\ttx\tty\ttz\n0\t0\tnan\t0\t0\t0\t0\t0\n",
    "short row": b"stack\tslice\trx\try\trz\ttx\tty\ttz\n0\t0\t0\n",
    "twice": b"stack\tslice\trx\try\trz\ttx\tty\ttz\n" + b"0\t0\t0\t0\t0\t0\t0\t0\n" * 2,
    "negative stack": b"stack\tslice\trx\try\trz\ttx\tty\ttz\n-7\t0\t0\t0\t0\t0\t0\t0\n",
    "a billion stacks": b"stack\tslice\trx\try\trz\ttx\tty\ttz\n999999999\t0\t0\t0\t0\t0\t0\t0\n",
    "beyond int64": b"stack\tslice\trx\try\trz\ttx\tty\ttz\n" + b"9" * 30 + b"\t0\t0\t0\t0\t0\t0\t0\n",
}


@pytest.mark.parametrize("name", TABLES)
def test_evaluate_with_a_bad_table_of_poses(name: str, tmp_path: Path, tally: Tally) -> None:
    volume, mask = write(tmp_path / "v.nii"), write(tmp_path / "m.nii", ball())
    table = tmp_path / "poses.tsv"
    if TABLES[name] is not None:
        table.write_bytes(TABLES[name] or b"")
    with tally.case() as case:
        line = ["--volume", volume, "--reference", volume, "--mask", mask, "--poses", table, "--slices", table]
        assert_refused(run(evaluate.main, line, tmp_path), "g3r-evaluate", "", "expected|check|no such file")
        case.refused()


def test_evaluate_writes_nowhere_else(tmp_path: Path, tally: Tally) -> None:
    volume, mask = write(tmp_path / "v.nii"), write(tmp_path / "m.nii", ball())
    for option in ("--json", "--sections"):
        with tally.case() as case:
            line = ["--volume", volume, "--reference", volume, "--mask", mask, option, tmp_path / "no" / "out"]
            outcome = run(evaluate.main, line, tmp_path)
            assert outcome.code == 3
            assert len(outcome.err.splitlines()) == 1
            assert outcome.changed == set()
            case.refused()
