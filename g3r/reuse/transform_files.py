"""Rigid motions as files of other programs: ITK's .tfm, and the .dof of MIRTK and IRTK.

Both map a point that the file's header puts at x to R x + t, as slices.tsv does.
"""

from __future__ import annotations

import struct
import warnings
from pathlib import Path

from scipy.spatial.transform import Rotation

from g3r.geometry import RigidPose
from g3r.geometry.lps import in_lps

DOF_MAGIC, DOF_RIGID, N_RIGID = 815007, 2, 6
"""First words of a .dof, the type of a rigid transformation, and the number of its parameters."""

DOF_FORMAT = ">3I6d"
"""Big-endian: magic number, type, number of parameters; tx, ty, tz in mm, rx, ry, rz in degrees. 60 bytes."""


def write_itk(path: Path, pose: RigidPose) -> None:
    """Write one motion as an ITK text file, which moves points in LPS.

    Written as an affine transform, which every reader of the format knows.

    Args:
        path: ends in .tfm.
        pose: one motion of points in RAS (mm).
    """
    import SimpleITK

    lps, transform = in_lps(pose), SimpleITK.AffineTransform(3)
    transform.SetMatrix(lps.rotation[0].ravel().tolist())
    transform.SetTranslation(lps.translation_mm[0].tolist())
    SimpleITK.WriteTransform(transform, str(path))


def dof_bytes(pose: RigidPose) -> bytes:
    """One motion as the content of a rigid .dof; its world is that of the NIfTI header (RAS, mm).

    Its matrix is (Rz Ry Rx)^T of the three angles.

    Source: MIRTK (github.com/BioMedIA/MIRTK), `Transformation::WriteDOFs` and `RigidParametersToMatrix`.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Gimbal lock")  # any of the equivalent triples will do
        angles_deg = Rotation.from_matrix(pose.rotation[0].T).as_euler("xyz", degrees=True)
    return struct.pack(DOF_FORMAT, DOF_MAGIC, DOF_RIGID, N_RIGID, *pose.translation_mm[0], *angles_deg)


def write_dof(path: Path, pose: RigidPose) -> None:
    """Write one motion as a rigid .dof, see `dof_bytes`."""
    path.write_bytes(dof_bytes(pose))
