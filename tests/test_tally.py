"""The table of counts reports lost cases."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tally import Case, Counts, Tally, table


def wrong_after_all(case: Case) -> None:
    case.refused()
    raise ZeroDivisionError


def test_cases_are_counted_and_errors_are_lost_and_go_on() -> None:
    rows: dict[str, Counts] = {}
    tally = Tally("bad input", rows)
    with tally.case():
        pass
    with tally.case() as case:
        case.refused()
    with pytest.raises(ZeroDivisionError), tally.case() as case:
        wrong_after_all(case)
    with tally.refusal():
        raise ValueError("says what was wrong")
    with pytest.raises(pytest.fail.Exception), tally.refusal():
        pass
    tally.named("fuzz").add(tried=10, survived=3, refused=6)
    assert rows["bad input"] == Counts(5, 1, 2)
    assert [rows[name].lost for name in ("bad input", "fuzz")] == [2, 1]
    assert table(rows)[-1].split() == ["all", "15", "4", "8", "3"]


@pytest.mark.parametrize("workers", [[], ["-n", "2"]])
@pytest.mark.parametrize("refused", [1, 2])
def test_the_table_is_printed_and_a_lost_case_fails_the_run(tmp_path: Path, refused: int, workers: list[str]) -> None:
    test = f"def test_one(tally):\n    tally.add(tried=3, survived=1, refused={refused})\n"
    (tmp_path / "test_kills.py").write_text(test)
    line = [
        sys.executable,
        "-m",
        "pytest",
        "-p",
        "no:cacheprovider",
        "-p",
        "tests.tally",
        str(tmp_path),
        "--rootdir",
        str(tmp_path),
        *workers,
    ]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    done = subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == (pytest.ExitCode.TESTS_FAILED if refused == 1 else 0), done.stdout
    lines = [line.split() for line in done.stdout.splitlines()]
    assert ["kills", "3", "1", str(refused), str(2 - refused)] in lines
