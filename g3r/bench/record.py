"""What every benchmark's record says of the machine, and tables between markers in a document."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

from g3r._version import __version__
from g3r.errors import InputError


def machine() -> dict[str, Any]:
    """Processor, cores, versions, and the commit where there is one."""
    model = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text(errors="replace").splitlines()
        model = next(
            (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), model
        )
    try:
        commit = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True,
            cwd=Path(__file__).parent,
        ).stdout.strip()  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        commit = ""
    versions = {name: version(name) for name in ("numba", "numpy", "torch", "scipy")}
    return {
        "processor": model, "cores": len(os.sched_getaffinity(0)), "system": platform.platform(),
        "python": platform.python_version(), "g3r": __version__, "commit": commit, **versions,
    }  # fmt: skip


def put_between_markers(path: Path, name: str, text: str) -> None:
    """Replace what stands between `<!-- NAME:begin -->` and `<!-- NAME:end -->` in a document.

    Raises:
        InputError: the document or its markers are missing.
    """
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    old = path.read_text(encoding="utf-8") if path.is_file() else ""
    if begin not in old or end not in old.split(begin, 1)[1]:
        raise InputError(
            f"{path}: no lines {begin} and {end}; expected both; put them where the text belongs"
        )
    before, rest = old.split(begin, 1)
    path.write_text(f"{before}{begin}\n{text.strip()}\n{end}{rest.split(end, 1)[1]}", encoding="utf-8")
