"""Unreadable files and folders in a folder of DICOM are counted and reported."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from g3r.cli.dicom_options import stacks_on_disk
from g3r.dicom.files import holds_dicom, is_dicom
from g3r.dicom.headers import read_images
from g3r.errors import InputError
from tests.dicom.conftest import block
from tests.dicom.dicom_files import Study


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """One series, a link to itself that cannot be opened, and a folder that not even root can list."""
    Study(tmp_path).write(*block(), 2)
    (tmp_path / "IM99999").symlink_to("IM99999")
    (tmp_path / "closed").mkdir()
    plain = os.scandir

    def scandir(path: Any = ".") -> Iterator[os.DirEntry[str]]:
        if str(path).endswith("closed"):
            raise PermissionError(13, "Permission denied", path)
        return plain(path)

    monkeypatch.setattr(os, "scandir", scandir)
    return tmp_path


def test_files_and_folders_are_counted(folder: Path) -> None:
    found = read_images(folder)
    assert len(found.images) == 12
    assert (found.n_damaged, found.n_unreadable) == (0, 2)
    assert not is_dicom(folder / "IM99999")
    assert holds_dicom(folder)


def test_a_run_warns_of_them(folder: Path, tmp_path: Path) -> None:
    options = argparse.Namespace(dicom=str(folder), dicom_out=None, series=None, output=str(tmp_path / "out"))
    with stacks_on_disk(options, replaces=False) as dicom:
        (warning,) = dicom.warnings
    assert warning == "--dicom: 2 files and folders cannot be read and are left out; check their permissions"


def test_a_folder_of_nothing_else_is_refused_with_the_reason(folder: Path) -> None:
    for path in folder.glob("IM0*"):
        path.unlink()
    with pytest.raises(InputError, match=r"no DICOM image, 2 files and folders that cannot be read; .*permissions"):
        read_images(folder)
