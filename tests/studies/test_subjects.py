"""Subjects of the studies: reproducibility, cache, true poses from files, alignment of volumes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from data_synth.simulator import SimulatedStack
from g3r.acquisition.images import Volume, save_volume
from g3r.acquisition.slicing import slices_from_stacks
from g3r.errors import InputError
from g3r.evaluation.case import SimulatedCase, load_case, read_true_poses
from g3r.evaluation.pose_error import PoseTable
from g3r.geometry import RigidPose, VolumeGrid
from studies import subjects
from studies.runs import aligned, header_error, off_share, orientation_deg
from studies.subjects import SubjectSpec, case_folders, data_folder, simulated_subject

SPEC = SubjectSpec(name="tiny", volume="week", motion="moderate", seed=1)


@pytest.fixture
def atlas(tmp_path: Path, rng: np.random.Generator) -> Path:
    """An atlas folder with one small head."""
    index = np.stack(np.meshgrid(*[np.arange(24)] * 3, indexing="ij"), -1) - 11.5
    mask = np.linalg.norm(index / [10, 11, 9], axis=-1) < 1
    data = np.where(mask, 500 + 100 * rng.random(mask.shape), 0).astype(np.float32)
    folder = tmp_path / "atlas" / "week"
    folder.mkdir(parents=True)
    save_volume(folder / "t2.nii.gz", data, np.diag([2.0, 2.0, 2.0, 1.0]))
    save_volume(folder / "mask.nii.gz", mask, np.diag([2.0, 2.0, 2.0, 1.0]))
    return tmp_path / "atlas"


def test_a_subject_that_another_process_made_meanwhile_is_taken(
    atlas: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two jobs of a study need the same subject at the same time."""
    cache = tmp_path / "cache"
    simulate = subjects.simulate_stacks

    def slower(*arguments: Any, **options: Any) -> list[SimulatedStack]:
        monkeypatch.setattr(subjects, "simulate_stacks", simulate)
        other = simulated_subject(SPEC, atlas, cache)
        written.append((other / "poses.tsv").stat().st_mtime_ns)
        return simulate(*arguments, **options)

    written: list[int] = []
    monkeypatch.setattr(subjects, "simulate_stacks", slower)
    folder = simulated_subject(SPEC, atlas, cache)
    assert [(folder / "poses.tsv").stat().st_mtime_ns] == written
    assert [path.name for path in cache.iterdir()] == [SPEC.name]


def test_subject_is_simulated_once_and_read_back(atlas: Path, tmp_path: Path) -> None:
    folder = simulated_subject(SPEC, atlas, tmp_path / "cache")
    written = (folder / "poses.tsv").stat().st_mtime_ns
    assert simulated_subject(SPEC, atlas, tmp_path / "cache") == folder
    assert (folder / "poses.tsv").stat().st_mtime_ns == written
    with pytest.raises(InputError, match="another specification"):
        simulated_subject(replace(SPEC, bias=0.15), atlas, tmp_path / "cache")
    case = load_case(folder)
    assert [stack.thickness_mm for stack in case.stacks] == [2.2] * 3
    spacing = case.truth.grid.spacing_mm  # each axis is stretched by its own factor of up to 5 %
    assert np.abs(spacing / 2 - 1).max() < 0.05
    assert len(set(np.round(spacing, 6))) == 3
    assert 1 < header_error(case).mean_mm < 40

    # both tables of true poses agree
    table = case.true
    (folder / "poses.tsv").unlink()
    other = read_true_poses(folder)
    assert other.keys == table.keys
    np.testing.assert_allclose(other.pose.rotation, table.pose.rotation, atol=1e-7)
    np.testing.assert_allclose(other.pose.translation_mm, table.pose.translation_mm, atol=1e-5)


def test_turned_subject_keeps_its_size(atlas: Path, tmp_path: Path) -> None:
    case = load_case(simulated_subject(replace(SPEC, turned=True), atlas, tmp_path / "cache"))
    axes = case.truth.affine[:3, :3] / case.truth.grid.spacing_mm
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-6)
    assert np.abs(axes).max() < 0.999
    # a result in scanner space is as oblique as the head; one that is rotated with it is upright
    assert orientation_deg(case, RigidPose.identity(1)) > 2
    assert orientation_deg(case, RigidPose(axes[None], np.ones((1, 3)))) == pytest.approx(0, abs=1e-3)


def test_error_of_a_hand_made_case(tmp_path: Path) -> None:
    """Two stacks, one left-handed; one slice in ten is 3 mm off by its header, and one is rotated by 90 degrees."""
    rows = []
    for stack, flip in enumerate([1.0, -1.0]):
        affine = np.diag([flip * 1.0, 1.0, 3.0, 1.0])
        affine[:3, 3] = [-flip * 9.5, -9.5, -13.5]
        image = np.random.default_rng(stack).random((20, 20, 10)).astype(np.float32)
        save_volume(tmp_path / f"stack-{stack}.nii.gz", image, affine)
        save_volume(tmp_path / f"mask-{stack}.nii.gz", np.ones((20, 20, 10), bool), affine)
        for k in range(10):
            frame, center = np.diag([flip, 1.0, 1.0]), np.array([0.0, 0.0, 3.0 * k - 13.5])
            if (stack, k) == (0, 4):
                center += [0, 3.0, 0]
            if (stack, k) == (1, 7):
                frame = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ frame
            rows.append({"stack": stack, "slice": k, "rotation": frame.tolist(), "center": center.tolist()})
    (tmp_path / "poses.json").write_text(json.dumps(rows), encoding="utf-8")
    case = load_case(tmp_path, thickness_mm=2.5)
    assert case.stacks[1].thickness_mm == 2.5
    error = header_error(case)
    assert error.median_mm < 0.1  # the rotated slice still affects the common motion slightly
    assert error.per_slice_mm[0, 4] == pytest.approx(3.0, abs=0.1)
    points = case.points_mm[1, 7][:, :2]
    assert error.per_slice_mm[1, 7] == pytest.approx(np.linalg.norm(points, axis=1).mean() * 2**0.5, rel=0.02)

    slices = slices_from_stacks(case.stacks)
    weight = np.ones(20)
    keys = list(zip(slices.stack_id.tolist(), slices.slice_index.tolist(), strict=True))
    assert off_share(error.per_slice_mm, slices, weight) == pytest.approx(2 / 20)
    weight[keys.index((0, 4))] = 0.4  # not used
    assert off_share(error.per_slice_mm, slices, weight) == pytest.approx(1 / 19)
    place_unknown = {key: mm for key, mm in error.per_slice_mm.items() if key != (1, 7)}
    assert off_share(place_unknown, slices, weight) == 0.0


def test_a_folder_without_poses(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"neither poses\.tsv nor poses\.json"):
        read_true_poses(tmp_path)
    with pytest.raises(InputError, match=r"no stack-N\.nii\.gz"):
        load_case(tmp_path)
    with pytest.raises(InputError, match="no case named x"):
        case_folders(["x"], tmp_path)


def test_cases_are_chosen_by_a_part_of_their_name_and_ordered_by_motion(tmp_path: Path) -> None:
    for name in ("b-severe", "a-mild-gap", "c-none", "a-single"):
        (tmp_path / name).mkdir()
    assert [f.name for f in case_folders(["*"], tmp_path)] == ["c-none", "a-mild-gap", "b-severe", "a-single"]
    assert [f.name for f in case_folders(["mild", "b-*"], tmp_path)] == ["a-mild-gap", "b-severe"]


def test_data_folder_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("G3R_TEST_DATA", str(tmp_path / "nothing"))
    with pytest.raises(InputError, match="set G3R_TEST_DATA"):
        data_folder("atlas")


def test_a_volume_far_away_is_brought_near_by_the_motion_of_its_slices(rng: np.random.Generator) -> None:
    """180 degrees and a metre away, with other intensities; alignment then finds the remaining millimetre."""
    shape = (40, 44, 36)
    truth = gaussian_filter(rng.normal(size=shape), 2.5)
    truth = (1 + truth / truth.std()).astype(np.float32)
    grid = VolumeGrid.isotropic([0, 0, 0], 1.5 * (np.array(shape) - 1), 1.5)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1)
    mask = np.linalg.norm((index - (np.array(shape) - 1) / 2) / (15, 17, 13), axis=-1) < 1
    case = SimulatedCase(name="head", folder=Path(), stacks=(), true=PoseTable((), RigidPose.identity(0)), points_mm={})
    case.__dict__.update(truth=Volume(truth, grid.affine, "truth"), truth_mask=mask)  # cached properties
    near = RigidPose.from_rotvec([[0.02, -0.03, 0.01]], [[1.0, -0.6, 0.4]])
    far = RigidPose.from_rotvec([[0.0, 0.0, 3.0]], [[1000.0, 0.0, 0.0]])
    found = aligned(case, 3.0 * truth + 7.0, grid.moved(far.inverse() @ near), far)
    assert found.scores.psnr_db > 45
    assert found.alignment is not None
    left = found.alignment.volume_from_reference @ near.inverse()
    assert np.linalg.norm(left.apply(grid.center_mm[None])[0] - grid.center_mm) < 0.05
