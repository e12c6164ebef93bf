"""The notebook runs from first to last cell, and is stored without outputs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.rooms import REPOSITORY

NOTEBOOK = REPOSITORY / "examples" / "reconstruct.ipynb"

RUN = """
import sys, nbclient, nbformat
notebook = nbformat.read(sys.argv[1], as_version=4)
nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
nbformat.write(notebook, sys.argv[2])
"""


def test_outputs_are_left_out() -> None:
    cells = [cell for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    assert cells
    assert not any(cell["outputs"] or cell["execution_count"] for cell in cells)


def test_all_cells_run_and_show_the_report_with_three_pictures(tmp_path: Path) -> None:
    """It runs in a separate process, because Jupyter's warnings must not fail this test."""
    done = tmp_path / "done.ipynb"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "MPLBACKEND": "agg"}
    line = [sys.executable, "-c", RUN, str(NOTEBOOK), str(done)]
    ran = subprocess.run(line, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
    assert ran.returncode == 0, ran.stderr[-3000:]
    cells = json.loads(done.read_text(encoding="utf-8"))["cells"]
    shown = [output.get("data", {}) for cell in cells if cell["cell_type"] == "code" for output in cell["outputs"]]
    (report,) = ["".join(one["text/html"]) for one in shown if "<b>use</b>" in "".join(one.get("text/html", ""))]
    assert report.count("data:image/png;base64,") == 3
    assert (tmp_path / "out" / "volume.nii.gz").is_file()
