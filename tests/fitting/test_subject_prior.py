"""Slices of a single stack are registered to their prior volume, which is then remade, as long as this helps."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.fitting import subject_prior
from g3r.fitting.subject_prior import SubjectPrior
from g3r.geometry import RigidPose, VolumeGrid
from g3r.prior.maps import DEFAULT_TILING
from g3r.registration import Registration
from tests.fitting.scene import make_slices
from tests.fitting.test_pose_rounds import registration_of

STEP_MM = 0.25


@pytest.mark.parametrize(("n_nearer", "n_moves", "n_made"), [(0, 8, 0), (3, 8, 3), (3, 2, 2), (3, 0, 0)])
def test_moves_are_made_while_they_bring_slices_nearer(
    n_nearer: int, n_moves: int, n_made: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each move starts at the end of the previous one, with the volume that was made there."""
    seen: list[NDArray[np.float32]] = []

    def moved(
        slices: Slices, gain: NDArray[np.float64], prior: NDArray[np.float32], grid: VolumeGrid
    ) -> tuple[Slices, NDArray[np.float64], bool]:
        seen.append(prior)
        if len(seen) > n_nearer:
            return slices, gain, False
        step = RigidPose(np.tile(np.eye(3), (len(slices), 1, 1)), np.tile([STEP_MM, 0, 0], (len(slices), 1)))
        return slices.with_pose(step @ slices.planes.pose), 1.1 * gain, True

    monkeypatch.setattr(subject_prior, "register_to_prior", moved)
    poses = single_stack()
    maker = SubjectPrior(network=None, voxel_mm=1.0, common_bias_field=False)
    before = maker.of(maker.volumes(poses), poses, 0, DEFAULT_TILING)
    after = maker.with_slices_moved(before, poses, n_moves, 0, DEFAULT_TILING)
    went_mm = after.volumes.slices.planes.center_mm - before.volumes.slices.planes.center_mm
    assert np.allclose(went_mm, [n_made * STEP_MM, 0, 0])
    assert np.allclose(after.gain, 1.1**n_made * before.gain)
    assert after.accepted is (n_made > 0)
    assert len(seen) == min(n_nearer + 1, n_moves)
    assert len({one.tobytes() for one in seen}) == len(seen)
    # intensities are those of the first volume, as recorded
    first, last = before.volumes.slices, after.volumes.slices
    assert np.allclose(last.value * after.scale, first.value * before.scale, rtol=1e-5)


def single_stack() -> Registration:
    slices = make_slices()
    return registration_of(slices.take(slices.stack_id == 0))
