"""Where numba keeps compiled kernels, decided before any is declared.

Numba looks for a folder that it may write when a kernel is declared: next to the source, then in the user's
cache folder; where neither can be written (a read-only installation and home), it raises. Then a folder of
this user among the temporary files takes their place. Nothing heavy is imported here.
"""

from __future__ import annotations

import hashlib
import os
import stat
import sys
import tempfile
from pathlib import Path

PACKAGE = Path(__file__).parents[1]

COMPILING_FIT_S = 22.0
"""Seconds that the kernels of the fit to the slices take to compile, on a core of the machine of the tables."""


def ensure_kernel_cache() -> None:
    """Set NUMBA_CACHE_DIR to a temporary folder where numba would find no folder of its own."""
    if os.environ.get("NUMBA_CACHE_DIR") or may_write(PACKAGE / "__pycache__") or may_write(_user_cache()):
        return
    folder = _temporary_folder()
    os.environ["NUMBA_CACHE_DIR"] = folder
    if "numba" in sys.modules:  # it has read its environment already
        sys.modules["numba"].config.CACHE_DIR = folder


def needs_compiling(room: str = "") -> bool:
    """Whether numba will compile: none of its results lies in the folders that it keeps them in.

    Args:
        room: package of the kernels that are asked for; all when empty.
    """
    rooms = [PACKAGE / room] if room else [path for path in PACKAGE.iterdir() if path.is_dir()]
    return not any(next(kept_in(one).glob("kernels*.nbi"), None) for one in rooms)


def kept_in(room: Path) -> Path:
    """The folder that numba keeps the kernels of a package in.

    A folder for all packages may serve other programs and other copies of g3r, so it has one of its own for each.

    Args:
        room: folder of the sources.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    if not given and may_write(room / "__pycache__"):
        return room / "__pycache__"
    name = f"{room.name}_{hashlib.sha1(os.fsencode(room), usedforsecurity=False).hexdigest()}"
    return (Path(given) if given else _user_cache()) / name


def may_write(folder: Path) -> bool:
    """Whether a folder can be written, or made where it does not exist yet."""
    try:
        while not folder.exists():
            if folder == folder.parent:
                return False
            folder = folder.parent
        return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)
    except OSError:
        return False


def _user_cache() -> Path:
    try:
        home = Path.home()
    except RuntimeError:  # no home at all
        return PACKAGE / "__pycache__"
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "numba"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", home)) / "numba"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "numba"


def _temporary_folder() -> str:
    """A folder that nobody else can write: its content is run as code."""
    name = f"g3r-kernels-{os.getuid() if hasattr(os, 'getuid') else 'user'}"
    folder = Path(tempfile.gettempdir()) / name
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        private = stat.S_ISDIR(found.st_mode) and not found.st_mode & 0o022
        if private and (not hasattr(os, "getuid") or found.st_uid == os.getuid()):
            return str(folder)
    except OSError:
        pass
    return tempfile.mkdtemp(prefix="g3r-kernels-")
