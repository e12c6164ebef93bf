"""Space of a result: form codes, and the transform from the scanner's space."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from g3r.cli.infer import main
from g3r.geometry import RigidPose
from g3r.registration.atlas_frame import motion_to_headers
from tests.cli.test_infer import files, inputs
from tests.output.test_inactive_terms import slices_of

QUICK = ("--preset", "fast", "--resolution", "1.5", "--no-prior", "--thickness", "4", "--threads", "1", "--quiet")
CODES = {"standard": 2, "scanner": 1}


def test_motion_to_headers_ignores_a_stray() -> None:
    slices = slices_of([0] * 9)
    common = RigidPose.from_rotvec([[0.3, -0.2, 0.5]], [[40.0, -12.0, 7.0]])
    moved = common @ slices.planes.pose
    stray = RigidPose.from_rotvec([[2.0, 0, 0]], [[90.0, 0, 0]])
    found = motion_to_headers(slices.with_pose(moved.with_rows([4], stray)))
    np.testing.assert_allclose(found.apply(common.apply(np.eye(3)[None])), np.eye(3)[None], atol=0.05)


@pytest.mark.parametrize("space", ["standard", "scanner"])
def test_form_codes_and_the_way_from_the_scanner(subject: Path, tmp_path: Path, space: str) -> None:
    out = tmp_path / "out"
    assert main([*map(str, inputs(subject)), *QUICK, "--space", space, "--output", str(out)]) == 0
    whole = json.loads((out / "run.json").read_text())
    record = whole["registration"]
    for path in out.glob("*.nii.gz"):
        header = nib.Nifti1Image.from_filename(path).header
        assert {int(header["sform_code"]), int(header["qform_code"])} == {CODES[record["space"]]}, path.name
    assert record["space"] == space
    if space == "scanner":
        assert record["standard_from_scanner"] is None
        assert all(stack["standard_from_scanner"] is None for stack in whole["stacks"])
        return
    matrix = np.array(record["standard_from_scanner"])
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6)
    # each slice is placed by slices.tsv; the common motion is within the motion of this head
    head = nib.Nifti1Image.from_filename(files(subject, "mask")[0])
    points = nib.affines.apply_affine(head.affine, np.argwhere(np.asarray(head.dataobj) > 0)[::500])
    common = points @ matrix[:3, :3].T + matrix[:3, 3]
    with (out / "slices.tsv").open() as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    poses = RigidPose.from_rotvec(
        *([[float(row[key]) for key in keys] for row in rows] for keys in (("rx", "ry", "rz"), ("tx", "ty", "tz")))
    )
    there = poses.apply(np.broadcast_to(points, (len(poses), *points.shape)))
    apart_mm = np.linalg.norm(there - common, axis=2).mean(1)
    assert np.median(apart_mm) < 3
    for n, stack in enumerate(whole["stacks"]):
        own = np.array(stack["standard_from_scanner"])
        there = poses.take([int(row["stack"]) == n for row in rows]).apply(points[None])
        assert np.median(np.linalg.norm(there - (points @ own[:3, :3].T + own[:3, 3]), axis=2)) < 1.5
    # the moved head is where the volume shows it
    mask = nib.Nifti1Image.from_filename(out / "mask.nii.gz")
    inside = nib.affines.apply_affine(mask.affine, np.argwhere(np.asarray(mask.dataobj) > 0))
    assert np.linalg.norm(common.mean(0) - inside.mean(0)) < 5
