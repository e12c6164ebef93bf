"""Subjects of the benchmarks: repeatable, cached, and their true poses read back from files."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from g3r.acquisition.images import save_volume
from g3r.errors import InputError
from g3r.evaluation.case import load_case, read_true_poses
from g3r.evaluation.pose_error import PoseTable
from g3r.geometry import RigidPose
from studies.motion.figure import draw_slice_errors, jerk_slices, places_in_time
from studies.motion.layers import case_folders
from studies.motion.sweep import LEVELS, specs
from studies.runs import orientation_deg
from studies.subjects import SubjectSpec, simulated_subject
from studies.subjects import test_data_folder as data_folder

RECIPE = SubjectSpec(name="tiny", volume="week", motion="moderate", seed=1)


@pytest.fixture
def atlas(tmp_path, rng):
    """A tree with one small head."""
    index = np.stack(np.meshgrid(*[np.arange(24)] * 3, indexing="ij"), -1) - 11.5
    mask = np.linalg.norm(index / [10, 11, 9], axis=-1) < 1
    data = np.where(mask, 500 + 100 * rng.random(mask.shape), 0).astype(np.float32)
    folder = tmp_path / "atlas" / "week"
    folder.mkdir(parents=True)
    save_volume(folder / "t2.nii.gz", data, np.diag([2.0, 2.0, 2.0, 1.0]))
    save_volume(folder / "mask.nii.gz", mask, np.diag([2.0, 2.0, 2.0, 1.0]))
    return tmp_path / "atlas"


def test_every_subject_has_a_seed_of_its_own():
    kinds = [{"turned": turned, "development": dev} for turned in (False, True) for dev in (False, True)]
    every = [one for kind in kinds for one in specs(LEVELS, 100, **kind)]
    assert len({one.seed for one in every}) == len({one.name for one in every}) == 1200
    assert specs(["severe"], 2)[1] == specs(LEVELS, 10)[21]


def test_subject_is_simulated_once_and_read_back(atlas, tmp_path):
    folder = simulated_subject(RECIPE, atlas, tmp_path / "cache")
    written = (folder / "poses.tsv").stat().st_mtime_ns
    assert simulated_subject(RECIPE, atlas, tmp_path / "cache") == folder
    assert (folder / "poses.tsv").stat().st_mtime_ns == written
    with pytest.raises(InputError, match="another recipe"):
        simulated_subject(replace(RECIPE, bias=0.15), atlas, tmp_path / "cache")
    case = load_case(folder)
    assert [stack.thickness_mm for stack in case.stacks] == [2.2] * 3
    spacing = case.truth.grid.spacing_mm  # stretched by up to a twentieth, each axis by its own factor
    assert np.abs(spacing / 2 - 1).max() < 0.05
    assert len(set(np.round(spacing, 6))) == 3
    assert 1 < case.header_error().mean_mm < 40

    # both tables of true poses say the same
    table = case.true
    (folder / "poses.tsv").unlink()
    other = read_true_poses(folder)
    assert other.keys == table.keys
    np.testing.assert_allclose(other.pose.rotation, table.pose.rotation, atol=1e-7)
    np.testing.assert_allclose(other.pose.translation_mm, table.pose.translation_mm, atol=1e-5)


def test_turned_subject_keeps_its_size(atlas, tmp_path):
    case = load_case(simulated_subject(replace(RECIPE, turned=True), atlas, tmp_path / "cache"))
    axes = case.truth.affine[:3, :3] / case.truth.grid.spacing_mm
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-6)
    assert np.abs(axes).max() < 0.999
    # a result in scanner space lies as askew as the head; one turned with it stands upright
    assert orientation_deg(case, RigidPose.identity(1)) > 2
    assert orientation_deg(case, RigidPose(axes[None], np.ones((1, 3)))) == pytest.approx(0, abs=1e-3)


def test_error_of_a_hand_made_case(tmp_path):
    """Two stacks, one left-handed; one slice in ten is 3 mm off by its header, and one 90 degrees turned."""
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
    error = case.header_error()
    assert error.median_mm < 0.1  # the turned slice still pulls a little at the common motion
    assert error.per_slice_mm[0, 4] == pytest.approx(3.0, abs=0.1)
    points = case.points_mm[1, 7][:, :2]
    assert error.per_slice_mm[1, 7] == pytest.approx(np.linalg.norm(points, axis=1).mean() * 2**0.5, rel=0.02)


def test_a_folder_without_poses(tmp_path):
    with pytest.raises(InputError, match=r"neither poses\.tsv nor poses\.json"):
        read_true_poses(tmp_path)
    with pytest.raises(InputError, match=r"no stack-N\.nii\.gz"):
        load_case(tmp_path)
    with pytest.raises(InputError, match="no case named x"):
        case_folders(tmp_path, ["x"])


def test_data_folder_that_is_not_there(tmp_path, monkeypatch):
    monkeypatch.setenv("G3R_TEST_DATA", str(tmp_path / "nothing"))
    with pytest.raises(InputError, match="set G3R_TEST_DATA"):
        data_folder()


def hand_made_jerk():
    """Ten slices, taken 0 2 4 6 8 1 3 5 7 9; the head jumps 5 mm before slice 8."""
    place = places_in_time(10)
    assert place.tolist() == [0, 5, 1, 6, 2, 7, 3, 8, 4, 9]
    shift = np.zeros((10, 3))
    shift[:, 0] = 0.1 * place + 5.0 * (place >= 4)
    keys = tuple((0, k) for k in range(10))
    points = {key: np.array([[10.0, 0, key[1]], [0, 10.0, key[1]]]) for key in keys}
    return PoseTable(keys, RigidPose(np.tile(np.eye(3), (10, 1, 1)), shift)), points


def test_jerks_are_found_in_the_order_of_time():
    assert jerk_slices(*hand_made_jerk()) == [[0, 4]]


def test_figure_of_two_cases(tmp_path):
    per_slice = [[0, k, 0.1 * k] for k in range(10)]
    layers = {name: {"per_slice_mm": per_slice} for name in ("headers", "slices", "something new")}
    case = {"layers": layers, "n_slices": [10], "jerks": [[0, 4]]}
    draw_slice_errors({"a": case, "b": case, "c": case}, tmp_path / "made" / "figure.png")
    assert (tmp_path / "made" / "figure.png").stat().st_size > 10_000
