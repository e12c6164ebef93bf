"""The shipped pose network on simulated subjects of weeks that it was not trained on."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import center_of_mass

from g3r.acquisition.images import load_mask, load_volume
from g3r.acquisition.slicing import slices_from_stacks
from g3r.checkpoints.shipped import weights_path
from g3r.evaluation.case import load_case
from g3r.geometry import RigidPose
from g3r.pose_network.model import PoseModel
from g3r.training.pose_scores import pose_errors, stack_motions


@pytest.fixture(scope="module")
def shipped() -> PoseModel:
    return PoseModel.load()


def test_the_file_is_small_and_says_what_it_is(shipped: PoseModel) -> None:
    assert weights_path(None, "pose").stat().st_size <= 6_000_000
    assert "sta30" in shipped.training_data  # named among the excluded subjects
    assert shipped.template.weeks.tolist() == [22, 25, 28, 31, 34, 37]
    assert {"val/slice_mm", "val/stack_deg", "val/stacks_within_20deg"} <= set(shipped.validation)
    np.testing.assert_allclose(shipped.template.volume, shipped.template.volume[:, ::-1], atol=2e-3)


@pytest.mark.parametrize("name", ["sta30-none", "sta30-moderate", "sta34-single"])
def test_stacks_stand_as_they_should(shipped: PoseModel, shared_data: Path, name: str) -> None:
    """The common motion of each stack is within 20 degrees of the truth, in the atlas frame."""
    folder = shared_data / "cases" / name
    if not folder.is_dir():
        pytest.skip(f"{name} is not among the test data")
    case = load_case(folder)
    slices = slices_from_stacks(list(case.stacks))
    reference = load_volume(folder / "truth.nii.gz")
    head_mm = reference.grid.world(center_of_mass(load_mask(folder / "truth-mask.nii.gz", reference)))
    row = {key: n for n, key in enumerate(case.true.keys)}
    keys = zip(slices.stack_id.tolist(), slices.slice_index.tolist(), strict=True)
    motion = case.true.pose.take([row[key] for key in keys])
    atlas_from_world = RigidPose(np.eye(3)[None], -head_mm[None])
    true = atlas_from_world @ motion @ slices.header_pose

    predicted = shipped.predict(slices)
    fitted = stack_motions(predicted, slices.header_pose, slices.stack_id)
    ideal = stack_motions(true, slices.header_pose, slices.stack_id)
    _, angle_deg = pose_errors(fitted, ideal)
    assert angle_deg.max() < 20.0
