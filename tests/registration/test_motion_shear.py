"""The open shear in the motion of slices: measured, compared with random walks, and removed without harm."""

from __future__ import annotations

import numpy as np
import pytest

from data_synth.motion import MotionLevel, slice_trajectory
from g3r.acquisition.orientations import mean_normals
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.geometry.rigid import fit_rigid
from g3r.registration.motion_shear import SHEAR_ERROR, motion_shear, without_excess_shear
from g3r.registration.open_strain import open_strain
from tests.gaussians.scenes import slices_of, stack_planes
from tests.registration.moving_heads import sheared

N, SPACING_MM = 24, 3.0
WALK = MotionLevel(walk_deg=0.3, walk_mm=0.15, offset_deg=3.0, offset_mm=2.0)


def still(n_stacks: int, n: int = N) -> Slices:
    """Orthogonal stacks at their header poses."""
    planes = stack_planes(n, SPACING_MM, 2)
    ones = np.ones(planes.n_pixels, np.float32)
    slices = slices_of(planes, ones, ones > 0, 3, SPACING_MM)
    return slices.take(slices.stack_id < n_stacks)


def walked(slices: Slices, interleave: int, seed: int, level: MotionLevel = WALK) -> Slices:
    rng, n_stacks = np.random.default_rng(seed), slices.n_stacks
    walks = [slice_trajectory(len(slices) // n_stacks, level, np.zeros(3), interleave, rng) for _ in range(n_stacks)]
    return slices.with_motion(RigidPose.concatenated(walks))


def apart_mm(one: Slices, other: Slices) -> float:
    """Root mean square distance of slice centres after a rigid motion."""
    common = fit_rigid(one.planes.center_mm, other.planes.center_mm)
    moved = common.apply(one.planes.center_mm)
    return float(np.sqrt(((moved - other.planes.center_mm) ** 2).sum(-1).mean()))


@pytest.mark.parametrize("amount", [-0.03, 0.01])
def test_the_strain_in_a_motion_is_found(amount: float) -> None:
    found = motion_shear(sheared(still(2), amount), [2, 2])
    assert found is not None
    strain = open_strain(mean_normals(still(2)))
    assert strain is not None
    same = np.sign(np.vdot(found.strain, strain))  # the sign of a strain is arbitrary
    assert found.amount * same == pytest.approx(amount, rel=0.02)


def test_motion_of_whole_stacks_has_none() -> None:
    of_stacks = RigidPose.from_rotvec([[0.2, -0.1, 0.3], [0.0, 0.3, -0.2]], [[9.0, 0, 1], [-4.0, 2, 0]])
    found = motion_shear(still(2).with_motion(of_stacks.take(np.repeat([0, 1], N))), [2, 2])
    assert found is not None
    assert abs(found.amount) < 1e-9
    assert found.likely < 1e-9


@pytest.mark.parametrize("interleave", [1, 2, 4])
def test_a_walk_has_as_much_of_it_as_is_said(interleave: int) -> None:
    found = [motion_shear(walked(still(2), interleave, seed), [interleave] * 2) for seed in range(40)]
    amounts, likely = np.array([[one.amount, one.likely] for one in found if one is not None]).T
    assert len(amounts) == 40
    # the median over the motions, because the estimate of a variance is skewed
    assert 0.6 < np.sqrt((amounts**2).mean()) / np.median(likely) < 1.6


def test_slices_in_the_order_of_their_places_keep_more_of_it_than_interleaved_ones() -> None:
    likely = {}
    for interleave in (1, 2):
        found = [motion_shear(walked(still(2), interleave, seed), [interleave] * 2) for seed in range(10)]
        likely[interleave] = np.median([one.likely for one in found if one is not None])
    assert likely[2] < 0.6 * likely[1]


@pytest.mark.parametrize("seed", range(4))
def test_poses_that_went_along_it_come_back(seed: int) -> None:
    true = walked(still(2), 2, seed)
    noise = np.random.default_rng(seed).normal(0, 1, (2, 2 * N, 3))
    gone = sheared(true, 0.03)
    astray = gone.with_motion(RigidPose.from_rotvec(noise[0] * 0.001, noise[1] * 0.05) @ gone.world_from_header())
    back = without_excess_shear(astray, [2, 2])
    assert apart_mm(back, true) < 0.5 * apart_mm(astray, true)


def test_a_drift_along_the_places_that_is_as_large_as_other_motion_stays() -> None:
    jerky = MotionLevel(walk_deg=2.0, walk_mm=1.5)
    true = walked(still(2), 1, 3, jerky)
    found = motion_shear(true, [1, 1])
    assert found is not None
    assert found.likely > 3 * SHEAR_ERROR
    assert apart_mm(without_excess_shear(true, [1, 1]), true) < 0.1 * abs(found.amount) * N * SPACING_MM


@pytest.mark.parametrize("n_stacks", [1, 3])
def test_one_orientation_and_three_leave_slices_where_they_are(n_stacks: int) -> None:
    slices = walked(still(n_stacks), 2, 0)
    assert motion_shear(slices, [2] * n_stacks) is None
    assert without_excess_shear(slices, [2] * n_stacks) is slices


@pytest.mark.parametrize("n", [2, 3])
def test_stacks_of_a_few_slices_are_no_error(n: int) -> None:
    slices = walked(still(2, n), 1, 0)
    assert np.isfinite(without_excess_shear(slices, [None, None]).planes.center_mm).all()
