"""log.txt: paths without folders, no messages of other libraries, and no failure if it cannot be written."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from g3r.run.log_file import LOG_NAME, LogFile


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("data/JANE/stack.nii.gz: odd", "stack.nii.gz: odd"),
        ("out/volume.nii.gz about a route out of here", "volume.nii.gz about a route DIR of here"),
        ("/mnt/some where/x.nii: odd", "x.nii: odd"),
        ('File "/usr/lib/python/json.py", line 3', 'File "json.py", line 3'),
        ("3 / 4 and a/b and 5 mm/s", "3 / 4 and a/b and 5 mm/s"),
        ("out.unfinished/stages: cannot be kept", "out.unfinished/stages: cannot be kept"),
    ],
)
def test_folders_are_left_out(text: str, told: str) -> None:
    log = LogFile(["data/JANE/stack.nii.gz"], ["out", "/mnt/some where"])
    assert log.hidden.left_out_of(text) == told


def test_what_others_log_stays_out_and_all_is_copied(tmp_path: Path) -> None:
    log, logger = LogFile(), logging.getLogger()
    logger.addHandler(log)
    try:
        logging.getLogger("g3r.somewhere").warning("ours")
        logging.getLogger("nibabel").warning("JANE")
        (tmp_path / "new").mkdir()
        log.keep_in(tmp_path)
        log.copy_to(tmp_path / "new")
        log.go_on_in(tmp_path / "new")
        log.say("later")
    finally:
        logger.removeHandler(log)
    lines = (tmp_path / "new" / LOG_NAME).read_text().splitlines()
    assert [line.split(" s  ")[1] for line in lines] == ["g3r.somewhere: warning: ours", "later"]
    assert len((tmp_path / LOG_NAME).read_text().splitlines()) == 1


def test_a_folder_that_is_gone_ends_nothing(tmp_path: Path) -> None:
    log = LogFile()
    log.keep_in(tmp_path / "gone")
    log.say("still here")
    assert len(log.lines) == 1
