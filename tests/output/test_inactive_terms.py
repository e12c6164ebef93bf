"""Inactive terms: run.json names the terms that the data cannot determine, with the reason."""

from dataclasses import replace

import numpy as np

from g3r.acquisition.planes import Planes, Slices
from g3r.geometry import RigidPose
from g3r.output.record import inactive_terms
from g3r.planning.presets import PRESETS, ReconstructionSettings


def slices_of(stacks: list[int]) -> Slices:
    n = len(stacks)
    planes = Planes(
        rotation=np.tile(np.eye(3), (n, 1, 1)),
        center_mm=np.zeros((n, 3)),
        spacing_mm=np.ones((n, 2)),
        shape=np.full((n, 2), 4),
        psf_var_mm2=np.ones((n, 3)),
    )
    pixels = np.ones(planes.n_pixels, np.float32)
    pose = RigidPose(planes.rotation, planes.center_mm)
    return Slices(
        planes=planes,
        value=pixels,
        mask=pixels > 0,
        stack_id=np.array(stacks),
        slice_index=np.arange(n),
        thickness_mm=np.full(n, 2.0),
        header_pose=pose,
    )


def terms(slices: Slices, settings: ReconstructionSettings = PRESETS["balanced"]) -> dict[str, str]:
    return {one.term: one.reason for one in inactive_terms(slices, settings)}


def test_two_stacks_of_slices_determine_everything() -> None:
    assert terms(slices_of([0, 0, 1, 1])) == {}


def test_a_single_slice_has_neither_gain_nor_bias_field() -> None:
    found = terms(slices_of([0]))
    assert set(found) == {"gain of the slice", "bias field of each stack"}
    assert "amplitudes" in found["gain of the slice"]


def test_settings_and_a_missing_prior_are_named() -> None:
    base = PRESETS["balanced"]
    still = replace(
        base, use_prior=False, slice_stage=replace(base.slice_stage, optimise_poses=False, optimise_bias_field=False)
    )
    found = terms(slices_of([0, 1]), still)
    assert set(found) == {"bias field of each stack", "poses in the fit", "distance to the prior"}
    assert "drifts" in terms(slices_of([0, 0]), still)["poses in the fit"]
    free = replace(base, distillation=False)
    assert "distillation" in terms(slices_of([0, 0]), free)["distance to the prior"]
    assert "several stacks" in terms(slices_of([0, 1]), free)["distance to the prior"]
