"""Target registration error: independent of a common motion, sensitive to errors of single slices."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from g3r.acquisition.images import save_volume
from g3r.errors import InputError
from g3r.evaluation.pose_error import PoseTable, SliceKey, read_poses, slice_points, target_registration_error
from g3r.geometry import RigidPose


@pytest.fixture
def points(rng: np.random.Generator) -> dict[SliceKey, np.ndarray]:
    """Two stacks of ten slices, 40 points each."""
    layout = {}
    for stack in range(2):
        for k in range(10):
            xy = rng.uniform(-30, 30, (40, 2))
            through = np.full(40, 4.0 * k - 18)
            layout[stack, k] = np.c_[xy, through] if stack == 0 else np.c_[through, xy]
    return layout


def random_poses(rng: np.random.Generator, n: int, degrees: float, mm: float) -> RigidPose:
    return RigidPose.from_rotvec(np.deg2rad(rng.normal(0, degrees, (n, 3))), rng.normal(0, mm, (n, 3)))


def test_a_common_motion_does_not_count(points: dict[SliceKey, np.ndarray], rng: np.random.Generator) -> None:
    keys = tuple(points)
    true = random_poses(rng, len(keys), 8, 4)
    common = random_poses(rng, 1, 30, 20)
    found = target_registration_error(points, PoseTable(keys, true), PoseTable(keys, common @ true))
    assert found.mean_mm < 1e-8
    assert (found.n_slices, found.n_missing) == (20, 0)


def test_known_shift_of_few_slices(points: dict[SliceKey, np.ndarray], rng: np.random.Generator) -> None:
    keys = tuple(points)
    true = random_poses(rng, len(keys), 8, 4)
    shift = np.zeros((20, 3))
    shift[3] = (30, 0, 0)  # a slice with a gross error must not tilt the others
    wrong = RigidPose(true.rotation, true.translation_mm + shift)
    found = target_registration_error(points, PoseTable(keys, true), PoseTable(keys, wrong))
    assert found.per_slice_mm[keys[3]] == pytest.approx(30, abs=0.1)
    assert found.median_mm < 0.05
    assert found.mean_mm == pytest.approx(1.5, abs=0.1)


def test_missing_and_foreign_slices(points: dict[SliceKey, np.ndarray], rng: np.random.Generator) -> None:
    keys = tuple(points)
    true = PoseTable(keys, random_poses(rng, len(keys), 8, 4))
    some = PoseTable(((9, 9), *keys[:15]), true.pose.take([0, *range(15)]))
    found = target_registration_error(points, true, some)
    assert (found.n_slices, found.n_missing) == (15, 5)
    with pytest.raises(InputError, match="no slice in common"):
        target_registration_error(points, true, PoseTable(((9, 9),), RigidPose.identity(1)))


def test_tables_are_read(tmp_path: Path, rng: np.random.Generator) -> None:
    pose = random_poses(rng, 2, 8, 4)
    rows = np.c_[pose.rotvec_rad(), pose.translation_mm]
    text = "stack\tslice\trx\try\trz\ttx\tty\ttz\treason\n"
    for k, row in enumerate(rows):
        text += f"1\t{k}\t" + "\t".join(f"{v:.9f}" for v in row) + "\t\n"
    path = tmp_path / "slices.tsv"
    path.write_text(text)
    table = read_poses(path)
    assert table.keys == ((1, 0), (1, 1))
    np.testing.assert_allclose(table.pose.rotation, pose.rotation, atol=1e-8)
    for bad, message in [
        (text.replace("rx", "ry"), "no column rx"),
        (text + text.splitlines()[1], "twice"),
        (text.replace("1\t0\t", "1\tzero\t"), "cannot be read"),
        ("", "no column"),
    ]:
        path.write_text(bad)
        with pytest.raises(InputError, match=message):
            read_poses(path)
    with pytest.raises(InputError, match="no such file"):
        read_poses(tmp_path / "nowhere.tsv")


def test_points_come_from_slices_with_enough_mask(tmp_path: Path) -> None:
    mask = np.zeros((12, 10, 3), np.uint8)
    mask[2:10, 1:9, 1] = 1
    mask[3:5, 3:5, 2] = 1  # four pixels are too few to place the slice
    affine = np.diag([-1.5, 1.0, 3.0, 1.0])
    affine[:3, 3] = (4, 5, 6)
    save_volume(tmp_path / "mask-0.nii.gz", mask, affine)
    found = slice_points([tmp_path / "mask-0.nii.gz"])
    assert set(found) == {(0, 1)}
    np.testing.assert_allclose(found[0, 1].min(0), (4 - 1.5 * 9, 6, 9))
    np.testing.assert_allclose(found[0, 1].max(0), (4 - 1.5 * 2, 13, 9))
