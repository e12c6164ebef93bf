"""A full disk, a quota, a limit on file size: one line of error, nothing half written, and a way to continue."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from g3r.errors import cannot_be_written
from tests.faults.small_case import WHOLE, Killed, SmallCase, names
from tests.tally import Tally

ENOUGH = "20m"
SIZES = ("16k", "200k", "600k", "1000k", "1400k", "2000k", "4m", ENOUGH)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """An empty folder where a small disk can be mounted; skips if this user may not mount."""
    place = tmp_path / "disk"
    place.mkdir()
    if shutil.which("mount") is None or not mounted(place, ENOUGH):
        pytest.skip("no tmpfs can be mounted here")
    subprocess.run(["umount", str(place)], check=True)
    yield place
    subprocess.run(["umount", str(place)], check=False, capture_output=True)


def mounted(place: Path, size: str) -> bool:
    line = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
    return subprocess.run(line, check=False, capture_output=True).returncode == 0


def last_line(output: str) -> str:
    assert "Traceback" not in output
    return output.splitlines()[-1]


@pytest.mark.faults
def test_a_full_disk_is_named_and_a_larger_one_gives_the_result(
    case: SmallCase, killed: Killed, small_disk: Path, tally: Tally
) -> None:
    codes = []
    for size in SIZES:
        with tally.case() as one:
            assert mounted(small_disk, size)
            out = small_disk / "out"
            ended = killed(case.arguments(out))
            codes.append(ended["code"])
            if ended["code"] == 0:
                assert names(small_disk) == {"out"}
                assert names(out) == WHOLE
            else:
                assert ended["code"] == 3, ended
                line = last_line(ended["output"])
                assert "No space left on device" in line
                assert "MB are free" in line
                assert names(small_disk) <= {"out.unfinished"}
                assert not (small_disk / "out.unfinished" / "new").exists()
                # the user frees space
                remount = ["mount", "-o", f"remount,size={ENOUGH}", str(small_disk)]
                subprocess.run(remount, check=True, capture_output=True)
                assert killed(case.arguments(out, "--resume"))["code"] == 0
                assert names(small_disk) == {"out"}
                one.refused()
            assert (out / "volume.nii.gz").read_bytes() == case.volume
            subprocess.run(["umount", str(small_disk)], check=True)
    assert {0, 3} == set(codes)


@pytest.mark.faults
def test_a_limit_on_the_size_of_files(case: SmallCase, killed: Killed, tmp_path: Path, tally: Tally) -> None:
    for file_bytes in (2_000, 20_000, 60_000, 100_000, 300_000):  # the command's output also goes to a file
        with tally.case() as one:
            ended = killed(case.arguments(tmp_path / "out"), file_bytes=file_bytes)
            assert ended["code"] == 3, ended
            assert "File too large" in last_line(ended["output"])
            assert names(tmp_path) <= {"out.unfinished"}
            one.refused()


def test_a_write_that_fails_leaves_the_earlier_result(
    case: SmallCase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tally: Tally
) -> None:
    """The last file cannot be written, as on a full disk."""
    out = tmp_path / "out"
    out.mkdir()
    for name in ("volume.nii.gz", "run.json"):
        (out / name).write_text("old")

    def full(*arguments: object, **options: object) -> None:
        raise cannot_be_written("sections.png", OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))

    monkeypatch.setattr("g3r.output.sections.save_sections", full)
    with tally.case() as one:
        assert case.run(out, "--force") == 3
        line = last_line(capsys.readouterr().err)
        assert line.startswith("g3r-infer: sections.png: cannot be written (No space left on device, ")
        assert (out / "volume.nii.gz").read_text() == "old"
        assert names(tmp_path) == {"out", "out.unfinished"}
        one.refused()
    with tally.case():
        monkeypatch.undo()
        assert case.run(out, "--force", "--resume") == 0
        assert len(json.loads((out / "run.json").read_text())["resumed"]) == 5
        assert names(out) == WHOLE
        assert names(tmp_path) == {"out"}


def test_stages_that_cannot_be_kept_do_not_end_a_run(
    case: SmallCase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tally: Tally
) -> None:
    def full(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("g3r.run.stage_store.write_stage", full)
    with tally.case():
        assert case.run(tmp_path / "out") == 0
        assert (tmp_path / "out" / "volume.nii.gz").read_bytes() == case.volume
        assert names(tmp_path) == {"out"}


def test_stages_give_way_where_only_that_makes_room(
    case: SmallCase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tally: Tally
) -> None:
    from g3r.run.output_folder import OutputFolder

    with OutputFolder(tmp_path / "out") as run:
        run.stages.mkdir()
        (run.stages / "registration.npz").write_bytes(bytes(1000))
        free = shutil.disk_usage(tmp_path)
        monkeypatch.setattr("shutil.disk_usage", lambda path: free._replace(free=500))
        run.make_room(400)
        run.make_room(2000)  # would still not be enough
        assert run.stages.exists()
        run.make_room(1400)
        assert not run.stages.exists()


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (errno.ENOSPC, "No space left on device, at most 2.0 MB are needed, "),
        (errno.EACCES, "Permission denied); choose another --output"),
    ],
)
def test_what_is_said_of_a_file_that_could_not_be_written(tmp_path: Path, number: int, expected: str) -> None:
    error = cannot_be_written(tmp_path / "no" / "file", OSError(number, os.strerror(number)), 2_000_000)
    assert expected in str(error)


@pytest.mark.faults
def test_a_memory_limit_ends_in_one_line(case: SmallCase, tmp_path: Path, tally: Tally) -> None:
    """Limits by ulimit -v, from far too little to enough."""
    codes = []
    for megabytes in (120, 200, 300, 450, 600, 800, 1000, 1100, 1200, 3000):
        with tally.case() as one:
            out = tmp_path / "out"
            line = [sys.executable, "-m", "g3r.cli.infer", *case.arguments(out)]
            done = subprocess.run(
                ["bash", "-c", f'ulimit -v {megabytes * 1000}; exec "$@"', "-", *line],
                check=False,
                capture_output=True,
                text=True,
                env=os.environ | {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA")},
            )
            codes.append(done.returncode)
            if done.returncode:
                if done.returncode == 4:
                    assert last_line(done.stderr).startswith("g3r-infer: out of memory; choose")
                else:  # messages of OpenBLAS or C++, when they start or begin a thread
                    assert done.returncode in (1, -signal.SIGABRT), done.stderr
                    assert "Traceback" not in done.stderr
                assert names(tmp_path) <= {"out.unfinished"}
                one.refused()
            else:
                assert (out / "volume.nii.gz").read_bytes() == case.volume
                assert names(tmp_path) == {"out"}
                shutil.rmtree(out)
    assert codes[0] == 4
    assert codes.count(4) >= len(codes) // 2
    assert codes[-1] == 0


def test_an_empty_mount_point_is_written_and_an_earlier_result_in_it_replaced(
    case: SmallCase, small_disk: Path, tally: Tally
) -> None:
    assert mounted(small_disk, ENOUGH)
    with tally.case():
        assert case.run(small_disk) == 0
        assert names(small_disk) == WHOLE
        assert (small_disk / "volume.nii.gz").read_bytes() == case.volume
    with tally.case() as one:
        assert case.run(small_disk) == 3
        one.refused()
    with tally.case():
        (small_disk / "notes").write_text("mine")
        (small_disk / "volume.nii.gz").write_text("old")
        assert case.run(small_disk, "--force") == 0
        assert names(small_disk) == WHOLE | {"notes"}
        assert (small_disk / "volume.nii.gz").read_bytes() == case.volume


@pytest.mark.parametrize("moved", range(9))
def test_a_run_killed_while_files_move_onto_a_mount_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tally: Tally, moved: int
) -> None:
    """However many files were moved, afterwards either the earlier or the new result is there, complete and alone."""
    from g3r.run.output_folder import OutputFolder

    monkeypatch.setattr("g3r.run.output_folder.is_mount", lambda folder: True)
    result = {"run.json", "volume", "mask"}
    out = tmp_path / "out"
    out.mkdir()
    for name in (*result, "notes"):
        (out / name).write_text("old")
    rename = os.rename
    done: list[Path] = []

    def killed(source: Path, target: Path) -> None:
        if len(done) == moved:
            raise KeyboardInterrupt
        done.append(target)
        rename(source, target)

    folder = OutputFolder(out, result)
    with tally.case(), folder:
        with suppress(KeyboardInterrupt), monkeypatch.context() as patch, folder.result() as staged:
            for name in result:
                (staged / name).write_text("new")
            patch.setattr("os.rename", killed)
            patch.setattr(folder, "_clean", lambda: None)  # a killed process does not clean up
        assert len(done) == moved
        folder._clean()  # the next process does
        assert names(out) - {".unfinished"} == result | {"notes"}
        whole = moved == 8  # three files out, the backup renamed, three in, the backup renamed again
        assert {(out / name).read_text() for name in result} == {"new" if whole else "old"}
        assert (out / "notes").read_text() == "old"


def test_a_mount_point_takes_a_result_without_a_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tally: Tally
) -> None:
    """DICOM series, exported poses and simulations have no run.json, and some have folders."""
    from g3r.run.output_folder import OutputFolder

    monkeypatch.setattr("g3r.run.output_folder.is_mount", lambda folder: True)
    out = tmp_path / "out"
    (out / "lost+found").mkdir(parents=True)
    (out / "lost+found" / "1").write_text("of the disk")
    for text in ("first", "second"):
        with tally.case():
            with OutputFolder(out) as run, run.result() as staged:
                (staged / "0001.dcm").write_text(text)
                (staged / "stack").mkdir()
                (staged / "stack" / "0.nii").write_text(text)
            assert names(out) == {"0001.dcm", "stack", "lost+found"}
            assert {path.read_text() for path in (out / "0001.dcm", out / "stack" / "0.nii")} == {text}
            assert (out / "lost+found" / "1").read_text() == "of the disk"


@pytest.mark.parametrize("moved", range(6))
def test_a_clean_up_of_a_mount_point_that_is_cut_short_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tally: Tally, moved: int
) -> None:
    from g3r.run.output_folder import OutputFolder

    monkeypatch.setattr("g3r.run.output_folder.is_mount", lambda folder: True)
    out = tmp_path / "out"
    for place, text in (("", "new"), (".unfinished/backup", "old")):
        (out / place).mkdir(parents=True, exist_ok=True)
        for name in ("a", "b"):
            (out / place / name).write_text(text)
    rename, n_done = os.rename, 0

    def killed(source: Path, target: Path) -> None:
        nonlocal n_done
        if n_done == moved:
            raise KeyboardInterrupt
        n_done += 1
        rename(source, target)

    with tally.case():
        folder = OutputFolder(out)
        with suppress(KeyboardInterrupt), monkeypatch.context() as patch:
            patch.setattr("os.rename", killed)
            folder._clean()
        folder._clean()
        assert names(out) == {"a", "b", ".unfinished"}
        assert {(out / name).read_text() for name in ("a", "b")} == {"old"}
