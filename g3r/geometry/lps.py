"""The world of ITK and DICOM, LPS+: its first two axes point to the left and to the back."""

from __future__ import annotations

import numpy as np

from g3r.geometry.rigid import RigidPose

LPS_FROM_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
"""[4, 4]; its own inverse."""


def in_lps(pose: RigidPose) -> RigidPose:
    """One motion of points in RAS (mm) as a motion of points in LPS, or the reverse."""
    axes = LPS_FROM_RAS[:3, :3]
    return RigidPose((axes @ pose.rotation[0] @ axes)[None], (axes @ pose.translation_mm[0])[None])
