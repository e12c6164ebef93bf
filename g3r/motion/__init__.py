"""Poses of stacks and slices from the images."""

from g3r.motion.estimate import MotionEstimate, MotionSettings, estimate_motion

__all__ = ["MotionEstimate", "MotionSettings", "estimate_motion"]
