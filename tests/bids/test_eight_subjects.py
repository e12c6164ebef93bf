"""Eight subjects with the real g3r-infer, one with a truncated file and one without overlap."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import unquote

import nibabel as nib
import numpy as np
import pytest

from g3r.cli.bids import main
from tests.bids.cohorts import rows, volumes
from tests.bids.data_sets import add_session

pytestmark = pytest.mark.slow

FAR_MM = 300.0


def moved(path: Path, folder: Path, along_x_mm: float) -> Path:
    """A copy of an image with a shifted header."""
    image = nib.Nifti1Image.from_filename(path)
    affine = image.affine.copy()
    affine[0, 3] += along_x_mm
    nib.save(nib.Nifti1Image(np.asarray(image.dataobj), affine), folder / path.name)
    return folder / path.name


def test_six_volumes_and_two_reasons(subject: Path, tmp_path: Path) -> None:
    stacks = [(f"run-{n}", subject / f"stack-{n}.nii.gz", subject / f"mask-{n}.nii.gz") for n in range(3)]
    whole = stacks[1][1].read_bytes()
    cut_off = [stacks[0], (stacks[1][0], whole[: len(whole) // 2], stacks[1][2]), stacks[2]]
    apart = [(name, *(moved(path, tmp_path, FAR_MM * n) for path in pair)) for n, (name, *pair) in enumerate(stacks)]
    for n in range(1, 9):
        add_session(tmp_path / "raw", f"0{n}", None, {3: cut_off, 8: apart}.get(n, stacks))  # type: ignore[arg-type]
    out = tmp_path / "out"
    line = [str(tmp_path / "raw"), str(out), "participant", "--jobs", "2", "--", "--preset", "preview"]
    assert main(line) == 1
    made = volumes(out)
    assert len(made) == 6
    table = rows(out)
    assert [label for label, row in table.items() if row["verdict"] == "failed"] == ["sub-03", "sub-08"]
    assert "sub-03_run-1_T2w.nii.gz: voxels cannot be read" in table["sub-03"]["reasons"]
    assert "expected scans of one head" in table["sub-08"]["reasons"]
    page = (out / "index.html").read_text()
    assert re.findall(r"<td class=session>(sub-\d\d)", page)[:2] == ["sub-03", "sub-08"]
    links = re.findall(r'(?:href|src)="([^"]+)"', page)
    assert len(links) == 6 * 2 + 2
    assert all((out / unquote(link)).is_file() for link in links)
    assert main(line) == 1
    assert volumes(out) == made
