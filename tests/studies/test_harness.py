"""The harness: resumed records, published tables, exit codes; every study starts."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import psutil
import pytest

from g3r.bench.record import machine_line
from g3r.errors import InputError
from studies.harness import Study, Task, results, resumed, stated
from studies.tables import details, spread, table

FOLDER = Path(__file__).resolve().parents[2] / "studies"
STUDIES = sorted(
    ".".join(path.relative_to(FOLDER.parent).with_suffix("").parts)
    for path in FOLDER.rglob("*.py")
    if "if __name__" in path.read_text(encoding="utf-8")
)
PAGE = "before\n<!-- squares:begin -->\nold\n<!-- squares:end -->\nafter\n"


def square(n: int, folder: Path) -> dict[str, int] | None:
    """A measurement that works only once, because the second time its file exists."""
    (folder / f"measured-{n}").touch(exist_ok=False)
    if n == 13:
        raise InputError("13 is refused")
    return None if n == 4 else {"n": n, "square": n * n, "process": os.getpid()}


def squares(folder: Path) -> Study:
    return Study(
        name="page.squares",
        about="Squares.",
        document="page.md",
        shared=("--jobs", "--threads", "--development"),
        options={"numbers": {"nargs": "+", "type": int}, "--unit": {"default": "mm"}},
        settings=lambda options: {"unit": options.unit},
        tasks=lambda options: [Task(str(n), square, (n, folder)) for n in options.numbers],
        tables=lambda record: {"squares": table(record["rows"].values(), {"n": "{n}", "squared": "{square}"})},
        verdict=lambda record: all(row["n"] < 9 for row in record["rows"].values()),
    )


def test_an_interrupted_study_goes_on_and_writes_its_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "page.md").write_text(PAGE)
    study, output = squares(tmp_path), ["--output", str(tmp_path / "out")]
    assert study.main(["3", "13", *output]) == InputError.exit_code
    assert "page.squares: 13 is refused" in capsys.readouterr().err
    assert list(json.loads((tmp_path / "out" / "squares.json").read_text())["rows"]) == ["3"]
    # 3 is not measured again, 4 has no row, rows are in the order of the tasks
    assert study.main(["2", "3", "4", *output, "--docs", str(tmp_path / "page.md")]) == 0
    assert "1 rows kept" in capsys.readouterr().out
    lines = "| n | squared |\n| --- | ---: |\n| 2 | 4 |\n| 3 | 9 |"
    machine = json.loads((tmp_path / "out" / "squares.json").read_text())["machine"]
    assert (tmp_path / "page.md").read_text() == PAGE.replace("old", f"{lines}\n\n{machine_line(machine)}")
    assert stated("| of commit 1 |", machine) == "| of commit 1 |"
    assert stated("Not measured yet.", machine) == "Not measured yet."
    assert stated("| a |", {"machine": machine, "weights": "ab"}).endswith(". Prior of weights ab.")
    assert (tmp_path / "out" / "squares.md").read_text() == lines + "\n"
    assert study.main(["9", *output]) == 1  # the study's verdict is False


def test_rows_of_other_settings_are_neither_mixed_nor_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study, output = squares(tmp_path), ["--output", str(tmp_path / "out")]
    assert study.main(["2", "3", *output]) == 0
    before = (tmp_path / "out" / "squares.json").read_bytes()
    assert study.main(["5", *output, "--unit", "m"]) == InputError.exit_code
    assert "measured with unit mm instead of m" in capsys.readouterr().err
    assert study.main(["2", *output, "--unit", "m", "--fresh"]) == InputError.exit_code  # row 3 would be lost
    assert (tmp_path / "out" / "squares.json").read_bytes() == before
    for path in tmp_path.glob("measured-*"):
        path.unlink()
    assert study.main(["2", "3", *output, "--unit", "m", "--fresh"]) == 0


def test_rows_that_are_renewed_or_were_skipped_are_not_kept(tmp_path: Path) -> None:
    new = {"preset": "fast", "machine": {"commit": "a"}, "rows": {}}
    path = tmp_path / "record.json"
    assert resumed(path, new, set()) == new
    path.write_text(json.dumps(new | {"rows": {"a": {"x": 1}, "b": {"x": 2}, "c": {"skipped": "no data"}}}))
    assert resumed(path, new, {"a"})["rows"] == {"b": {"x": 2, "commit": "a"}}
    own = {"d": {"x": 3, "commit": "b"}, "e": {"x": 4, "commit": None}}
    path.write_text(json.dumps(new | {"rows": {"b": {"x": 2}, **own}}))
    assert resumed(path, new, set())["machine"]["commit"] == "a, b, unknown"  # tables name their commits
    path.write_text("[]")
    with pytest.raises(InputError, match="not a record"):
        resumed(path, new, set())


def test_jobs_run_in_processes_of_their_own(tmp_path: Path) -> None:
    assert squares(tmp_path).main(["2", "3", "--jobs", "2", "--output", str(tmp_path / "out")]) == 0
    rows = json.loads((tmp_path / "out" / "squares.json").read_text())["rows"]
    assert [row["square"] for row in rows.values()] == [4, 9]
    assert os.getpid() not in {row["process"] for row in rows.values()}


def failing(n: int, folder: Path) -> dict[str, int]:
    if n == 0:
        raise ValueError("of the first one")
    (folder / f"measured-{n}").touch()
    time.sleep(0.1)
    return {}


def test_nothing_more_is_measured_once_a_job_failed(tmp_path: Path) -> None:
    tasks = [Task(str(n), failing, (n, tmp_path)) for n in range(100)]
    with pytest.raises(ValueError, match="of the first one"):
        list(results(tasks, 2, 1))
    assert len(list(tmp_path.iterdir())) < 50


def endless(n: int, folder: Path) -> dict[str, int]:
    (folder / f"process-{os.getpid()}").touch()
    while True:
        time.sleep(1)


ENDLESS = """
from pathlib import Path
from studies.harness import Task, results
from tests.studies.test_harness import endless
if __name__ == "__main__":
    list(results([Task(str(n), endless, (n, Path({folder!r}))) for n in range(2)], 2, 1))
"""


def test_workers_end_with_a_command_that_was_killed(tmp_path: Path) -> None:
    script, started = tmp_path / "endless.py", tmp_path / "started"
    script.write_text(ENDLESS.format(folder=str(started)))
    started.mkdir()
    environment = {**os.environ, "PYTHONPATH": str(FOLDER.parent)}
    with subprocess.Popen([sys.executable, str(script)], env=environment, cwd=FOLDER.parent) as run:
        wait_until(lambda: len(list(started.iterdir())) == 2)
        run.kill()
    workers = [int(path.name.removeprefix("process-")) for path in started.iterdir()]
    wait_until(lambda: not any(psutil.pid_exists(one) for one in workers))


def wait_until(happened: Callable[[], bool], limit_s: float = 60) -> None:
    end = time.monotonic() + limit_s
    while not happened():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.1)


def test_subjects_that_were_looked_at_are_not_published(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "page.md").write_text(PAGE)
    words = ["2", "--development", "--docs", str(tmp_path / "page.md"), "--output", str(tmp_path)]
    assert squares(tmp_path).main(words) == InputError.exit_code
    assert "leave out --development" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        squares(tmp_path).main(["2", "--jobs", "0"])


def test_cells_of_tables() -> None:
    rows = [{"name": "a", "scores": {"V prior": 1.26}}, {"name": "b", "scores": {}}]
    text = table(rows, [("", "{name}"), ("dB", "{scores[V prior]:.1f}"), ("dB", lambda row: len(row["scores"]))])
    assert text.splitlines() == ["|  | dB | dB |", "| --- | ---: | ---: |", "| a | 1.3 | 1 |", "| b |  | 0 |"]
    assert [spread([1.0, 2.0, 3.0], "{:+.1f}"), spread([1.0]), spread([])] == ["+2.0 ± 1.0", "1.00", "-"]
    assert details("All", "x") == "<details><summary>All</summary>\n\nx\n\n</details>"


@pytest.mark.parametrize("module", STUDIES)
def test_every_study_starts(module: str, capsys: pytest.CaptureFixture[str]) -> None:
    found = import_module(module)
    with pytest.raises(SystemExit, match="0"):
        (found.STUDY if hasattr(found, "STUDY") else found).main(["--help"])
    assert f"python -m {module}" in capsys.readouterr().out
