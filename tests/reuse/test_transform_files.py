"""Poses in file formats of other programs move points like slices.tsv."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import SimpleITK
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.cli.export_poses import main
from g3r.evaluation.pose_error import PoseTable, read_poses
from g3r.geometry import RigidPose
from g3r.reuse.finished_run import FinishedRun
from g3r.reuse.transform_files import DOF_FORMAT, dof_bytes, write_itk

TO_LPS = np.array([-1.0, -1.0, 1.0])
TOLERANCE_MM = 1e-6


@pytest.fixture
def points_mm(rng: np.random.Generator) -> NDArray[np.float64]:
    """A hundred points (RAS) within the reach of a scanner."""
    return rng.uniform(-200, 200, (100, 3))


@pytest.fixture(scope="module")
def poses(finished: Path) -> PoseTable:
    return read_poses(finished / "slices.tsv")


def exported(finished: Path, form: str, folder: Path) -> Path:
    assert main([str(finished), "--format", form, "--output", str(folder)]) == 0
    return folder


def name_of(key: tuple[int, int]) -> str:
    return f"stack-{key[0]}_slice-{key[1]:03d}"


def dof_matrix(content: bytes) -> NDArray[np.float64]:
    """The matrix [4, 4] of a rigid .dof file, entry by entry as in MIRTK."""
    magic, kind, n_parameters, *parameters = struct.unpack(DOF_FORMAT, content)
    assert (magic, kind, n_parameters) == (0x000C6F9F, 2, 6)
    (cx, cy, cz), (sx, sy, sz) = (f(np.deg2rad(parameters[3:])) for f in (np.cos, np.sin))
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [cy * cz, cy * sz, -sy],
        [sx * sy * cz - cx * sz, sx * sy * sz + cx * cz, sx * cy],
        [cx * sy * cz + sx * sz, cx * sy * sz - sx * cz, cx * cy],
    ]
    matrix[:3, 3] = parameters[:3]
    return matrix


def test_tfm_moves_points_as_the_table_does(
    finished: Path, poses: PoseTable, points_mm: NDArray[np.float64], tmp_path: Path
) -> None:
    folder = exported(finished, "itk", tmp_path / "itk")
    assert {path.name for path in folder.iterdir()} == {
        *(f"{name_of(key)}.tfm" for key in poses.keys),
        "standard_from_scanner.tfm",
    }
    for k, key in enumerate(poses.keys):
        transform = SimpleITK.ReadTransform(str(folder / f"{name_of(key)}.tfm"))
        moved = np.array([transform.TransformPoint(point) for point in (points_mm * TO_LPS).tolist()]) * TO_LPS
        np.testing.assert_allclose(moved, poses.pose.take([k]).apply(points_mm[None])[0], rtol=0, atol=TOLERANCE_MM)


def test_nitransforms_reads_them_alike(
    finished: Path, poses: PoseTable, points_mm: NDArray[np.float64], tmp_path: Path
) -> None:
    linear = pytest.importorskip("nitransforms.linear", reason="the dev extra is not installed")
    folder = exported(finished, "itk", tmp_path / "itk")
    for k, key in enumerate(poses.keys):
        transform = linear.Affine.from_filename(folder / f"{name_of(key)}.tfm", fmt="itk")
        expected = poses.pose.take([k]).apply(points_mm[None])[0]
        # nitransforms keeps matrices in float32, which resolves 2e-5 mm at 350 mm
        np.testing.assert_allclose(transform.map(points_mm), expected, rtol=0, atol=1e-4)


def test_the_common_motion_is_written_too(finished: Path, run: FinishedRun, tmp_path: Path) -> None:
    expected = np.array(run.registration.standard_from_scanner)
    folder = exported(finished, "mirtk", tmp_path / "mirtk")
    np.testing.assert_allclose(
        dof_matrix((folder / "standard_from_scanner.dof").read_bytes()), expected, rtol=0, atol=TOLERANCE_MM
    )
    transform = SimpleITK.ReadTransform(str(exported(finished, "itk", tmp_path / "itk") / "standard_from_scanner.tfm"))
    moved = np.array(transform.TransformPoint((10.0, -20.0, 30.0))) * TO_LPS
    np.testing.assert_allclose(moved, expected[:3, :3] @ [-10, 20, 30] + expected[:3, 3], atol=1e-6)


def test_dof_moves_points_as_the_table_does(
    finished: Path, poses: PoseTable, points_mm: NDArray[np.float64], tmp_path: Path
) -> None:
    folder = exported(finished, "mirtk", tmp_path / "mirtk")
    for k, key in enumerate(poses.keys):
        matrix = dof_matrix((folder / f"{name_of(key)}.dof").read_bytes())
        moved = points_mm @ matrix[:3, :3].T + matrix[:3, 3]
        np.testing.assert_allclose(moved, poses.pose.take([k]).apply(points_mm[None])[0], rtol=0, atol=TOLERANCE_MM)


def test_dof_bytes_come_back(rng: np.random.Generator) -> None:
    """Parameters of any size, in the order of the file, are read as a matrix and written again."""
    for _ in range(50):
        angles_deg = rng.uniform([-180, -89, -180], [180, 89, 180])
        content = struct.pack(DOF_FORMAT, 815007, 2, 6, *rng.uniform(-100, 100, 3), *angles_deg)
        assert len(content) == 60
        matrix = dof_matrix(content)
        again = dof_bytes(RigidPose(matrix[None, :3, :3], matrix[None, :3, 3]))
        assert again[:36] == content[:36]  # words and translation are exact; angles passed through sine and cosine
        np.testing.assert_allclose(struct.unpack(">3d", again[36:]), angles_deg, atol=1e-9)
        assert struct.pack(DOF_FORMAT, *struct.unpack(DOF_FORMAT, again)) == again


def test_a_dof_of_known_bytes() -> None:
    """Bytes of a 90 degree rotation about z (IRTK's angle has the opposite sign) and a translation."""
    pose = RigidPose(Rotation.from_euler("z", -90, degrees=True).as_matrix()[None], np.array([[1.0, -2.0, 0.5]]))
    expected = "000c6f9f00000002000000063ff0000000000000c0000000000000003fe0000000000000"
    content = dof_bytes(pose)
    assert content[:36].hex() == expected
    np.testing.assert_allclose(struct.unpack(">3d", content[36:]), [0, 0, 90], atol=1e-12)


@pytest.mark.parametrize("rotvec", [(0, 0, 0), (0, np.pi / 2, 0), (np.pi, 0, 0), (1e-9, 0, 0), (0, -np.pi / 2, 0)])
def test_turns_at_the_edges(rotvec: tuple[float, float, float], points_mm: NDArray[np.float64], tmp_path: Path) -> None:
    pose = RigidPose.from_rotvec([rotvec], [[3.0, -4.0, 5.0]])
    expected = pose.apply(points_mm[None])[0]
    matrix = dof_matrix(dof_bytes(pose))
    np.testing.assert_allclose(points_mm @ matrix[:3, :3].T + matrix[:3, 3], expected, atol=1e-5)
    write_itk(tmp_path / "one.tfm", pose)
    transform = SimpleITK.ReadTransform(str(tmp_path / "one.tfm"))
    moved = np.array([transform.TransformPoint(point) for point in (points_mm * TO_LPS).tolist()]) * TO_LPS
    np.testing.assert_allclose(moved, expected, rtol=0, atol=TOLERANCE_MM)
