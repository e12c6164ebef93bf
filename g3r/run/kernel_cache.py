"""The folder of numba's compiled kernels, chosen before any kernel is declared.

When a kernel is declared, numba looks for a writable folder: next to the source, then in the user's cache folder. If
neither is writable (a read-only installation and home), it raises. This module then substitutes a folder of this user
among the temporary files. It imports nothing heavy.
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
"""Seconds to compile the kernels of the fit to the slices, on one core of the machine of the tables."""


def ensure_kernel_cache() -> None:
    """Set NUMBA_CACHE_DIR to a temporary folder if numba would find no writable folder of its own."""
    if os.environ.get("NUMBA_CACHE_DIR") or may_write(PACKAGE / "__pycache__") or may_write(_user_cache()):
        return
    folder = _temporary_folder()
    os.environ["NUMBA_CACHE_DIR"] = folder
    if "numba" in sys.modules:  # numba has already read its environment
        sys.modules["numba"].config.CACHE_DIR = folder


def needs_compiling(room: str = "") -> bool:
    """Whether numba will have to compile: no compiled kernels lie in its cache folders.

    Args:
        room: package of the kernels in question; all packages when empty.
    """
    rooms = [PACKAGE / room] if room else [path for path in PACKAGE.iterdir() if path.is_dir()]
    return not any(next(kept_in(one).glob("kernels*.nbi"), None) for one in rooms)


def kept_in(room: Path) -> Path:
    """The folder in which numba keeps the compiled kernels of a package.

    A cache folder outside the package may serve other programs and other copies of g3r, so each package has a
    subfolder there.

    Args:
        room: folder of the sources.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    if not given and may_write(room / "__pycache__"):
        return room / "__pycache__"
    name = f"{room.name}_{hashlib.sha1(os.fsencode(room), usedforsecurity=False).hexdigest()}"
    return (Path(given) if given else _user_cache()) / name


def may_write(folder: Path) -> bool:
    """Whether a folder is writable, or can be created if it does not exist."""
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
    """A temporary folder that no other user can write, because its content is executed."""
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
