"""Settings of a quick whole reconstruction: a short registration, few Gaussians and few steps."""

from __future__ import annotations

from dataclasses import replace

from g3r.fitting.pose_rounds import PoseRoundSettings
from g3r.planning.presets import PRESETS

_FAST = PRESETS["fast"]

QUICK_FIT = replace(
    _FAST,
    gaussian_spacing_pixels=2.85,
    max_gaussian_spacing_mm=4.0,
    pose_rounds=PoseRoundSettings(single_stack=0, two_stacks=0, more_stacks=0),
    voxel_correction=None,
    registration=replace(_FAST.registration, n_rounds=3, finest_voxel_mm=1.6, max_pixels=100_000),
    prior_stage=replace(_FAST.prior_stage, n_steps=6),
    slice_stage=replace(_FAST.slice_stage, n_steps=32),
)
