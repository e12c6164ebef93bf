"""Export of the folder of slices, and reading as NeSVoR does."""

from __future__ import annotations

import csv
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from numpy.typing import NDArray

from g3r.cli.export_poses import main
from g3r.evaluation.pose_error import read_poses
from g3r.reuse.finished_run import FinishedRun
from g3r.reuse.slice_folder import slice_affines
from tests.cli.test_infer import files

TOLERANCE_MM = 1e-4
THICKNESS_MM = 4.0


@pytest.fixture
def folder(exported: Path) -> Path:
    return exported


def images(folder: Path, prefix: str = "") -> list[nib.Nifti1Image]:
    n = sum(path.name[0].isdigit() for path in folder.glob("*.nii.gz"))
    return [nib.Nifti1Image.from_filename(folder / f"{prefix}{k}.nii.gz") for k in range(n)]


def middle_and_axes(image: nib.Nifti1Image) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Centre (the third axis has one voxel) and frame of a slice, as NeSVoR reads them from a header."""
    middle = nib.affines.apply_affine(image.affine, [(n - 1) / 2 for n in image.shape[:2]] + [0])
    return middle, image.affine[:3, :3] / image.header.get_zooms()


def test_the_slices_come_back_where_they_were(folder: Path, run: FinishedRun) -> None:
    planes = run.geometry.slices.planes
    found = images(folder / "slices")
    assert len(found) == len(planes)
    for k, image in enumerate(found):
        middle, axes = middle_and_axes(image)
        reach_mm = float((planes.shape[k] * planes.spacing_mm[k]).max())
        np.testing.assert_allclose(middle, planes.center_mm[k], atol=TOLERANCE_MM)
        np.testing.assert_allclose(axes * reach_mm, planes.rotation[k] * reach_mm, atol=TOLERANCE_MM)
        np.testing.assert_allclose(image.header.get_zooms(), [1.5, 1.5, THICKNESS_MM], atol=1e-5)
        assert np.linalg.det(image.affine[:3, :3]) > 0  # NeSVoR would mirror left-handed slices
        np.testing.assert_allclose(image.header.get_qform(), image.affine, atol=TOLERANCE_MM)


def test_pixels_and_places_are_those_of_the_stack_after_its_motion(
    subject: Path, finished: Path, folder: Path, run: FinishedRun
) -> None:
    """A pixel of the stack that the header puts at x is in the folder at R x + t."""
    stacks = [nib.Nifti1Image.from_filename(path) for path in files(subject, "stack")]
    table = read_poses(finished / "slices.tsv")
    with (folder / "index.tsv").open() as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    assert [(int(row["stack"]), int(row["slice"])) for row in rows] == list(table.keys)
    masks = images(folder / "slices", "mask_")
    for k, image in enumerate(images(folder / "slices")):
        inside = np.asarray(masks[k].dataobj) > 0
        assert inside.sum() >= 12
        values = np.asarray(image.dataobj)
        assert not values[~inside].any()
        there = nib.affines.apply_affine(image.affine, np.argwhere(inside))
        by_header = table.pose.take([k]).inverse().apply(there[None])[0]
        stack = stacks[table.keys[k][0]]
        index = nib.affines.apply_affine(np.linalg.inv(stack.affine), by_header)
        np.testing.assert_allclose(index, np.rint(index), atol=1e-3)
        assert set(np.rint(index[:, 2]).astype(int)) == {table.keys[k][1]}
        i, j, s = np.rint(index).astype(int).T
        np.testing.assert_allclose(np.asarray(stack.dataobj)[i, j, s], values[inside], rtol=1e-6)


def test_the_model_predicts_the_slices(folder: Path) -> None:
    measured, predicted, inside = (
        np.concatenate([np.asarray(one.dataobj, dtype=float).ravel() for one in images(folder / name, prefix)])
        for name, prefix in (("slices", ""), ("simulated", ""), ("simulated", "mask_"))
    )
    measured, predicted = measured[inside > 0], predicted[inside > 0]
    assert np.corrcoef(measured, predicted)[0, 1] > 0.9
    assert np.abs(measured - predicted).mean() < 0.1 * measured.mean()


def test_without_stacks_only_predicted_slices_are_written(finished: Path, run: FinishedRun, tmp_path: Path) -> None:
    assert main([str(finished), "--format", "nesvor", "--output", str(tmp_path / "out")]) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"simulated", "index.tsv"}
    found = images(tmp_path / "out" / "simulated")
    affines = slice_affines(run.geometry.slices)
    np.testing.assert_allclose([one.affine for one in found], affines, atol=TOLERANCE_MM)
