"""Poses of stacks and slices from the images."""

from g3r.registration.estimate import MotionEstimate, estimate_motion
from g3r.registration.settings import MotionSettings

__all__ = ["MotionEstimate", "MotionSettings", "estimate_motion"]
