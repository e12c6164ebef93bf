"""Systems other than Linux: a small reconstruction without the modules and functions that they lack."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.faults.small_case import WHOLE, SmallCase, names
from tests.tally import Tally

HIDE = {
    "macOS": """
import os, psutil
del os.sched_getaffinity
del psutil.Process.cpu_affinity
""",
    "Windows": """
import os, psutil, sys  # psutil itself knows Windows
sys.modules["fcntl"] = sys.modules["resource"] = None
for name in ("sched_getaffinity", "sysconf"):
    delattr(os, name)
""",
}
"""Code that hides the modules and functions that each system lacks."""


@pytest.mark.parametrize("system", HIDE)
def test_a_small_subject_without_what_only_linux_has(
    case: SmallCase, tmp_path: Path, tally: Tally, system: str
) -> None:
    with tally.case():
        out = tmp_path / "out"
        # without --threads, and without /proc as far as it can be hidden
        arguments = [one for one in case.arguments(out) if one != "--quiet"]
        code = (
            f"{HIDE[system]}\nimport pathlib\nfrom g3r.run import machine\n"
            "machine._STATUS = pathlib.Path('absent')\n"
            f"import sys\nfrom g3r.cli.infer import main\nsys.exit(main({arguments!r}))"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert names(out) == WHOLE
        assert names(tmp_path) == {"out"}
        assert (out / "volume.nii.gz").read_bytes() == case.volume
        assert json.loads((out / "run.json").read_text())["peak_memory_bytes"] > 1e7
