"""Poses of stacks and slices from the images."""

from g3r.motion.estimate import MotionEstimate, estimate_motion
from g3r.motion.settings import MotionSettings

__all__ = ["MotionEstimate", "MotionSettings", "estimate_motion"]
