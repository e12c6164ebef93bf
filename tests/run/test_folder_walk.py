"""The walk through a folder with links."""

from __future__ import annotations

from pathlib import Path

from g3r.run.folder_walk import walked


def test_links_are_followed_once(tmp_path: Path) -> None:
    elsewhere, folder = tmp_path / "elsewhere", tmp_path / "folder"
    elsewhere.mkdir()
    folder.mkdir()
    (elsewhere / "b").touch()
    (elsewhere / "a").touch()
    (folder / "link").symlink_to(elsewhere)
    (folder / "second").symlink_to(elsewhere)
    (elsewhere / "circle").symlink_to(folder)
    assert list(walked(folder)) == [(folder, []), (folder / "link", ["a", "b"])]
    assert not list(walked(tmp_path / "nothing"))
