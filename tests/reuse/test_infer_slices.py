"""`g3r-infer --slices`: given poses instead of a search, and the transform back to the frame of the files."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from g3r.acquisition.images import load_volume
from g3r.acquisition.slicing import normalised_slices, slices_from_stacks
from g3r.cli.export_poses import main as export_poses
from g3r.cli.infer import main
from g3r.evaluation.metrics import score
from g3r.geometry import RigidPose
from g3r.output.files import MASK_NAMES, OUTPUT_NAMES
from g3r.planning.presets import PRESETS
from g3r.pose_network.model import PoseModel
from g3r.registration.given import GIVEN, measure
from g3r.reuse.finished_run import FinishedRun
from g3r.reuse.slice_folder import slice_affines
from g3r.reuse.slice_input import read_slice_folder
from tests.cli.test_infer import QUICK as WITH_THICKNESS
from tests.reuse.runs import truth_from_run

QUICK = tuple(word for word in WITH_THICKNESS if word not in ("--thickness", "4"))

ELSEWHERE = RigidPose.from_rotvec([[0.5, -0.8, 0.3]], [[40.0, -70.0, 25.0]])
"""Motion from the frame of the finished run to that of the test's slices."""

MAX_LOSS_DB = 0.3
"""Accepted PSNR loss with given poses against the run that found them; a gain of 0.3 was seen, from the second fit."""


@pytest.fixture(scope="module")
def moved(exported: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The exported slices in another frame and without an index, as from another tool."""
    folder = tmp_path_factory.mktemp("moved")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = ELSEWHERE.rotation[0], ELSEWHERE.translation_mm[0]
    for path in (exported / "slices").iterdir():
        image = nib.Nifti1Image.from_filename(path)
        nib.save(nib.Nifti1Image(np.asarray(image.dataobj), matrix @ image.affine), folder / path.name)
    return folder


@pytest.fixture(scope="module")
def again(moved: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of a run of the moved slices, with the other settings of `finished`."""
    folder = tmp_path_factory.mktemp("again") / "out"
    options = ("--preset", "fast", "--resolution", "1.2", "--threads", "1", "--quiet")
    assert main(["--slices", str(moved), *options, "--output", str(folder)]) == 0
    return folder


def in_truth(subject: Path, finished: Path, points_mm: NDArray[np.float64], name: str) -> NDArray[np.float32]:
    """The true volume or mask at points [P, 3] of the space of the finished run."""
    truth = load_volume(subject / name)
    index = truth.grid.index(truth_from_run(subject, finished).apply(points_mm[None])[0])
    return map_coordinates(truth.data, index.T, order=1)


def psnr(subject: Path, finished: Path, folder: Path, to_finished: RigidPose) -> float:
    """PSNR (dB) of a run's volume against the truth, after its points are mapped to the space of the finished run."""
    volume = load_volume(folder / "volume.nii.gz")
    points = to_finished.apply(volume.grid.world(np.argwhere(np.ones(volume.data.shape)))[None])[0]
    truth, mask = (
        in_truth(subject, finished, points, f"{name}.nii.gz").reshape(volume.data.shape)
        for name in ("truth", "truth-mask")
    )
    return score(volume.data, truth, mask > 0.5).psnr_db


def test_every_output_is_there(again: Path) -> None:
    assert {path.name for path in again.iterdir()} == {*OUTPUT_NAMES} - {*MASK_NAMES}


def test_the_volume_is_as_good_as_that_of_the_run_and_leads_back(subject: Path, finished: Path, again: Path) -> None:
    """The recorded motion maps the volume back to the frame of the slice files."""
    recorded = FinishedRun.load(again).standard_from_scanner
    assert recorded is not None
    before = psnr(subject, finished, finished, RigidPose.identity(1))
    after = psnr(subject, finished, again, ELSEWHERE.inverse() @ recorded.inverse())
    assert before > 18
    assert after > before - MAX_LOSS_DB
    # the head is in standard orientation again, which is accurate to a few degrees
    turn = recorded @ ELSEWHERE
    assert np.rad2deg(Rotation.from_matrix(turn.rotation[0]).magnitude()) < 12


def test_slices_in_standard_orientation_stay(exported: Path, run: FinishedRun) -> None:
    """A volume from poses in standard space has the place of the volume of their run."""
    stacks, given = read_slice_folder(exported)
    slices, _ = normalised_slices(stacks)
    found = measure(slices, given, PRESETS["preview"].registration, template=PoseModel.load(None).template)
    assert found.orientation is not None
    assert run.registration.correlation_with_template is not None
    assert found.orientation.correlation > run.registration.correlation_with_template - 0.05
    np.testing.assert_allclose(found.slices.planes.center_mm, run.geometry.slices.planes.center_mm, atol=1e-4)


def test_the_record_says_where_poses_come_from(again: Path, moved: Path) -> None:
    text = (again / "run.json").read_text()
    assert str(moved) not in text
    record = json.loads(text)
    assert record["registration"]["initialisation"] == GIVEN
    assert record["registration"]["space"] == "standard"
    assert record["registration"]["reliable"] is True
    assert any("grouped into stacks by their headers: stack-0 of 14 slices (0-13)" in note for note in record["notes"])
    assert [stack["name"] for stack in record["stacks"]] == ["stack-0", "stack-1", "stack-2"]
    assert [stack["thickness_from"] for stack in record["stacks"]] == ["header"] * 3
    for stack in record["stacks"]:
        assert stack["quality"]["held_out_correlation"] > 0.7
        assert stack["quality"]["median_slice_ncc"] > 0.8
    assert len(record["inputs"]["stacks"]) == len(record["inputs"]["masks"]) == 3


def test_kept_poses_are_those_of_the_files(exported: Path, tmp_path: Path) -> None:
    words = ["--slices", str(exported), "--keep-poses", "--space", "scanner", *QUICK, "--output", str(tmp_path / "out")]
    assert main(words) == 0
    run = FinishedRun.load(tmp_path / "out")
    stacks, given = read_slice_folder(exported)
    slices = slices_from_stacks(stacks)
    expected = slices.with_motion(given.motion_of(slices)).planes
    np.testing.assert_allclose(run.geometry.slices.planes.center_mm, expected.center_mm, atol=1e-6)
    np.testing.assert_allclose(run.geometry.slices.planes.rotation, expected.rotation, atol=1e-9)
    assert run.space == "scanner"
    assert any("poses in the fit" in term.term for term in run.record.inactive_terms)
    assert any("by index.tsv" in note for note in run.record.notes)


def test_the_slices_go_out_again_with_their_last_poses(
    again: Path, moved: Path, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(again), "--format", "nesvor", "--output", str(tmp_path / "out"), "--slices"]
    assert export_poses([*words, str(moved)]) == 0
    run = FinishedRun.load(again)
    affines = slice_affines(run.geometry.slices)
    for k, affine in enumerate(affines):
        folders = (moved, tmp_path / "out" / "slices")
        first, last = (nib.Nifti1Image.from_filename(folder / f"{k}.nii.gz") for folder in folders)
        np.testing.assert_array_equal(np.asarray(first.dataobj), np.asarray(last.dataobj))
        np.testing.assert_allclose(last.affine, affine, atol=1e-4)
    # the folder with an index does not match: its slices have other places and other numbers
    shutil.rmtree(tmp_path / "out")
    capsys.readouterr()
    assert export_poses([*words, str(exported)]) == 3
    assert "slices grid" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_poses_that_are_wrong_are_noticed(exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With a stack 12 mm and 20 degrees off, the measured quality says that stacks do not agree."""
    shutil.copytree(exported, tmp_path / "in")
    wrong = np.eye(4)
    wrong[:3, :3], wrong[:3, 3] = Rotation.from_rotvec([0, 0.35, 0]).as_matrix(), [12, 0, 0]
    for number in range(14):
        for name in (f"{number}.nii.gz", f"mask_{number}.nii.gz"):
            path = tmp_path / "in" / "slices" / name
            image = nib.Nifti1Image.from_filename(path)
            nib.save(nib.Nifti1Image(np.asarray(image.dataobj), wrong @ image.affine), path)
    words = ["--slices", str(tmp_path / "in"), "--keep-poses", "--space", "scanner", *QUICK]
    assert main([*words, "--output", str(tmp_path / "out")]) == 0
    assert "verdict: do not use" in capsys.readouterr().out
    registration = FinishedRun.load(tmp_path / "out").registration
    assert registration.reliable is False


def test_a_dry_run_says_what_was_found(exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--slices", str(exported / "slices"), "--dry-run", "--no-prior", "--output", str(tmp_path / "out")]
    assert main(words) == 0
    said = capsys.readouterr()
    assert "44 slices with given poses, in 3 stacks by index.tsv" in said.out + said.err
    assert "stack-0: " in said.out
    assert "thickness 4 mm (header)" in said.out
    assert not (tmp_path / "out").exists()
