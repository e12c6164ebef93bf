"""Commands without the packages of their extra end with one line that names what to install."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

HIDDEN = {"g3r.cli.evaluate": ("skimage", "evaluate"), "g3r.cli.pretrain": ("lightning", "train")}


@pytest.mark.parametrize("command", HIDDEN)
def test_a_command_names_the_extra_that_it_needs(command: str, subject: Path) -> None:
    package, extra = HIDDEN[command]
    truth, mask = subject / "truth.nii.gz", subject / "truth-mask.nii.gz"
    arguments = {
        "g3r.cli.evaluate": ["--volume", str(truth), "--reference", str(truth), "--mask", str(mask), "--align"],
        "g3r.cli.pretrain": ["fit"],
    }[command]
    code = f"import sys\nsys.modules[{package!r}] = None\nfrom {command} import main\nsys.exit(main({arguments!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 3, done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert f"pip install '.[{extra}]' in a checkout" in done.stderr
