"""Rendering of a finished run on other grids; on its own grid it gives the run's volume."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g3r.acquisition.images import Volume, load_volume, save_volume
from g3r.cli.render import main
from g3r.errors import InputError
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import on_grid
from g3r.reuse.finished_run import FinishedRun
from g3r.reuse.rendering import render_volume, target_grid
from tests.cli.test_infer import files
from tests.reuse.runs import dice, read, reconstruct


def largest_difference(folder: Path) -> float:
    """Largest difference of the rendered from the written volume, relative to its range."""
    run, written = FinishedRun.load(folder), read(folder / "volume.nii.gz")
    return float(np.abs(render_volume(run, target_grid(run).evaluated) - written).max() / np.ptp(written))


def test_on_its_own_grid_it_is_the_volume(finished: Path, run: FinishedRun) -> None:
    assert run.geometry.grid.shape != run.geometry.prior_grid.shape  # otherwise half of the mixture would not be tested
    assert 0 < run.record.prior_weight < 1
    assert run.record.edge_by_image  # the edge by the image is used, not that of the masks
    assert largest_difference(finished) < 1e-6


def test_so_it_is_without_a_prior_and_with_blank_unseen_parts(subject: Path, tmp_path: Path) -> None:
    reconstruct(subject, tmp_path / "run", "--no-prior", "--space", "scanner", "--unseen", "blank")
    assert largest_difference(tmp_path / "run") < 1e-6
    with pytest.raises(InputError, match="standard orientation is not known"):
        target_grid(FinishedRun.load(tmp_path / "run"), space="standard")


def test_so_it_is_with_a_correction(subject: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    reconstruct(subject, out, "--preset", "balanced", "--resolution", "1.2")
    run = FinishedRun.load(out)
    assert run.record.voxel_correction is not None
    assert run.record.voxel_correction.size > 0
    assert largest_difference(out) < 1e-6
    without = replace(run.mixture, correction=None).volume(run.cloud, run.geometry.grid)
    assert not np.allclose(without * run.geometry.intensity_scale, read(out / "volume.nii.gz"), rtol=1e-3)


def test_a_finer_grid_holds_the_same_head(finished: Path, run: FinishedRun, tmp_path: Path) -> None:
    out = tmp_path / "fine.nii.gz"
    assert main([str(finished), "--resolution", "0.6", "--output", str(out)]) == 0
    fine, volume = load_volume(out), load_volume(finished / "volume.nii.gz")
    np.testing.assert_allclose(fine.grid.spacing_mm, 0.6, rtol=1e-6)
    inside = read(finished / "mask.nii.gz") > 0
    at_voxels = on_grid(fine.data, fine.grid, run.geometry.grid, outside=0.0)
    # trilinear interpolation blurs slightly, so values agree only approximately
    assert np.corrcoef(at_voxels[inside], volume.data[inside])[0, 1] > 0.999


def test_another_space_is_another_affine_for_the_same_voxels(finished: Path, run: FinishedRun, tmp_path: Path) -> None:
    out = tmp_path / "scanner.nii.gz"
    assert main([str(finished), "--space", "scanner", "--output", str(out)]) == 0
    moved, volume = (nib.Nifti1Image.from_filename(path) for path in (out, finished / "volume.nii.gz"))
    data = np.asarray(volume.dataobj)
    np.testing.assert_allclose(np.asarray(moved.dataobj), data, atol=1e-6 * np.ptp(data))
    to_standard = np.array(run.registration.standard_from_scanner)
    np.testing.assert_allclose(to_standard @ moved.affine, volume.affine, atol=1e-4)
    assert {int(moved.header["sform_code"]), int(moved.header["qform_code"])} == {1}


def test_in_scanner_space_it_lies_on_the_stacks(subject: Path, finished: Path, tmp_path: Path) -> None:
    out, stack = tmp_path / "like.nii.gz", files(subject, "stack")[0]
    assert main([str(finished), "--space", "scanner", "--like", str(stack), "--output", str(out)]) == 0
    rendered, seen = load_volume(out), load_volume(stack)
    np.testing.assert_allclose(rendered.affine, seen.affine, atol=1e-4)
    inside = read(files(subject, "mask")[0]) > 0
    head = rendered.data > 0.2 * np.percentile(rendered.data, 99)
    assert dice(head, inside) > 0.85  # the head moved by a few mm


def test_a_header_with_few_digits_gives_the_values_of_the_whole_ones(run: FinishedRun) -> None:
    """Direction cosines with five decimals, which stacks may have, too."""
    grid, shape, spacing_mm = run.geometry.grid, (40, 36, 12), [1.1, 1.1, 3.0]
    rotation = Rotation.from_rotvec([0.4, 0.7, -1.1]).as_matrix()
    rounded = np.round(rotation[:, :2], 5)
    rendered = []
    for axes in (rotation, np.column_stack([rounded, np.cross(*rounded.T)])):
        affine = np.eye(4)
        affine[:3, :3] = axes * spacing_mm
        affine[:3, 3] = grid.center_mm - affine[:3, :3] @ ((np.array(shape) - 1) / 2)
        target = target_grid(run, like=Volume(np.zeros(shape, np.float32), affine, "t.nii.gz"))
        rendered.append(render_volume(run, target.evaluated))
    assert 1e-6 < target.written.shear < 1e-5
    apart = np.abs(rendered[1] - rendered[0]) / np.ptp(rendered[0])
    # voxels move by 0.0003 mm at most; single ones differ by the remainder of a Gaussian that is cut off
    assert apart.max() < 1e-2
    assert np.sqrt((apart**2).mean()) < 1e-4


def test_what_cannot_be_rendered_says_so(run: FinishedRun) -> None:
    with pytest.raises(InputError, match=r"resolution 0\.01 mm; expected 0\.1 to 10 mm"):
        target_grid(run, 0.01)
    with pytest.raises(InputError, match="choose a coarser grid"):
        target_grid(run, 0.1)
    sheared = np.diag([1.0, 1.0, 1.0, 1.0])
    sheared[0, 1] = 0.3
    with pytest.raises(InputError, match=r"axes are sheared \(cosine 0\.29\); expected at most 0\.001"):
        target_grid(run, like=Volume(np.zeros((4, 4, 4), np.float32), sheared, "t.nii.gz"))


def test_a_left_handed_grid_and_one_far_away(finished: Path, run: FinishedRun, tmp_path: Path) -> None:
    grid = run.geometry.grid
    flipped = grid.affine @ np.diag([-1.0, 1, 1, 1])
    flipped[:3, 3] = grid.world([grid.shape[0] - 1, 0, 0])
    written = read(finished / "volume.nii.gz")
    rendered = render_volume(run, VolumeGrid(grid.shape, flipped))[::-1]
    # rounding decides where a Gaussian is cut off, so single voxels may differ by its remainder
    assert np.abs(rendered - written).max() < 1e-2 * np.ptp(written)
    assert np.median(np.abs(rendered - written)) < 1e-6 * np.ptp(written)
    far = np.eye(4)
    far[:3, 3] = 9000
    save_volume(tmp_path / "far.nii.gz", np.ones((5, 5, 5), np.float32), far)
    out = tmp_path / "out.nii.gz"
    assert main([str(finished), "--like", str(tmp_path / "far.nii.gz"), "--output", str(out)]) == 0
    assert not read(out).any()
