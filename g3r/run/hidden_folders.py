"""Paths without their folders: what outputs may say of the user's files."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable

ABSOLUTE = re.compile(r"(?<![\w./])(?:/[^\s/:;,'\"]+)+/(?=[^\s/])")
"""Folders of any path from the root, such as those of a traceback."""


class HiddenFolders:
    """Folders of the user that no output may name.

    Args:
        folders: as the user wrote them; each is hidden in its absolute and resolved spelling, too.
    """

    def __init__(self, folders: Iterable[str] = ()) -> None:
        self.spelled: set[str] = set()
        self.add(folders)

    def add(self, folders: Iterable[str]) -> None:
        """Hide some more folders."""
        for folder in folders:
            if not folder or "\0" in folder:  # that no file can have: it is refused later
                continue
            spelled = (folder, os.path.abspath(folder), os.path.realpath(folder))
            self.spelled |= {one.rstrip(os.sep) + os.sep for one in spelled if one.strip("./\\")}

    def left_out_of(self, text: str) -> str:
        """A text in which paths are names of files."""
        for folder in sorted(self.spelled, key=len, reverse=True):
            whole = re.escape(folder.rstrip(os.sep))
            text = re.sub(rf"(?<![\w./-]){whole}[/\\]+(?=[^\s/])", "", text)  # a name may be a part of a word
            text = re.sub(rf"(?<![\w./-]){whole}(?![\w.-])", "DIR", text)
        return ABSOLUTE.sub("", text)


def name_alone(word: str) -> str:
    """A word of a command line, or the value in --option=value, without the folders that a path names."""
    option, equals, value = word.partition("=") if word.startswith("--") else ("", "", word)
    separators = [one for one in (os.sep, os.altsep) if one]
    if value in (os.curdir, os.pardir) or any(one in value for one in separators):
        value = os.path.basename(os.path.abspath(value)) or os.sep  # abspath: of data/ and of . the name, too
    return option + equals + value
