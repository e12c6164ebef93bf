"""Unseen parts: they are not evidence for poses, and spans of a single stack keep the length of the header."""

import numpy as np
import pytest

from g3r.acquisition.area_profile import area_profiles
from g3r.acquisition.atlas_template import PlacedHead
from g3r.acquisition.planes import Planes, Slices
from g3r.acquisition.psf import psf_variance_mm2
from g3r.geometry import RigidPose, VolumeGrid
from g3r.geometry.rigid import rotation_matrix
from g3r.registration.held_out import coverage_without, held_out_score, volume_without
from g3r.registration.normal_equations import SampledSlices
from g3r.registration.overlap import overlap_of
from g3r.registration.similarity import StackSamples
from g3r.registration.slice_neighbours import NeighbourTie
from g3r.registration.unseen import coverage_share, filled_with_head, grid_with_head, sampled, with_header_spans


def upper_halves_gone(slices: Slices) -> Slices:
    """Slices without the second half of every stack."""
    kept = [rows[: len(rows) // 2] for n in range(3) for rows in [np.flatnonzero(slices.stack_id == n)]]
    return slices.take(np.concatenate(kept))


def the_head(slices: Slices) -> PlacedHead:
    """The head itself as template: a volume of all its slices."""
    volume, grid = volume_without(slices, -1, 3.2)
    return PlacedHead(volume, grid, slices.planes.pixel_world_mm(slices.pixel_index).mean(0))


def test_the_template_stands_for_what_others_did_not_see(still_slices: tuple[Slices, RigidPose]) -> None:
    slices = still_slices[0]
    halves = upper_halves_gone(slices)
    samples, still = StackSamples.of_all(halves), RigidPose.identity(len(halves))
    alone = held_out_score(halves, samples, still).correlations
    filled = held_out_score(halves, samples, still, the_head(slices)).correlations
    assert max(alone) < 0.7
    assert min(filled) > 0.75


def test_the_fill_leaves_what_was_seen(still_slices: tuple[Slices, RigidPose]) -> None:
    slices = still_slices[0]
    fill = the_head(slices)
    halves = upper_halves_gone(slices)
    grid = grid_with_head(fill.grid, fill)
    volume = np.full(grid.shape, 0.5, np.float32)
    coverage = np.zeros(grid.shape, np.float32)
    coverage[: grid.shape[0] // 2] = 1
    found = filled_with_head(volume, grid, coverage, fill)
    assert (found[: grid.shape[0] // 2] == 0.5).all()
    assert found[grid.shape[0] // 2 :].max() > 0.2
    assert volume_without(halves, 0, 3.2, fill)[1].shape >= volume_without(halves, 0, 3.2)[1].shape


def test_share_of_coverage() -> None:
    share = coverage_share(np.array([0.0, 0.1, 1.0, 1.0, 1.0, 9.0], np.float32))
    assert share[0] == 0
    assert 0 < share[1] < 1
    assert (share[2:] == 1).all()
    assert (coverage_share(np.zeros(4, np.float32)) == 0).all()


def box_stacks(*stacks: tuple[np.ndarray, float, np.ndarray]) -> Slices:
    """Stacks about the origin, 60 mm wide: rotation [3, 3], size of pixels (mm), and heights of slices (mm) of each."""
    n = [len(height) for _, _, height in stacks]
    rotation = np.concatenate([np.tile(turn, (len(height), 1, 1)) for turn, _, height in stacks])
    height_mm = np.concatenate([height for *_, height in stacks])
    pixel_mm = np.repeat([pixel for _, pixel, _ in stacks], n)
    spacing_mm = np.repeat([float(np.diff(height).min()) for *_, height in stacks], n)
    planes = Planes(
        rotation=rotation,
        center_mm=height_mm[:, None] * rotation[:, :, 2],
        spacing_mm=np.stack([pixel_mm, pixel_mm], axis=1),
        shape=np.rint(60 / np.stack([pixel_mm, pixel_mm], axis=1)).astype(int),
        psf_var_mm2=psf_variance_mm2(np.stack([pixel_mm, pixel_mm], axis=1), spacing_mm),
    )
    return Slices(
        planes=planes,
        value=np.ones(planes.n_pixels, np.float32),
        mask=np.ones(planes.n_pixels, bool),
        stack_id=np.repeat(np.arange(len(stacks)), n),
        slice_index=np.concatenate([np.rint((one - one[0]) / np.diff(one).min()).astype(int) for *_, one in stacks]),
        thickness_mm=spacing_mm,
        header_pose=planes.pose,
    )


SAGITTAL = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


def seen_at(slices: Slices, points_mm: np.ndarray) -> np.ndarray:
    """How far all stacks saw points [P, 3]."""
    share, grid = coverage_without(slices, -1, 3.2)
    return sampled(share, grid, points_mm)


@pytest.mark.parametrize("n_lower", [0, 1, 2, 11])
def test_what_one_stack_saw_is_seen_however_many_others_did_not(n_lower: int) -> None:
    whole, lower = np.arange(-28.0, 30, 4), np.arange(-28.0, 0, 4)
    slices = box_stacks((SAGITTAL, 1.0, whole), *[(np.eye(3), 1.0, lower)] * n_lower)
    points_mm = np.random.default_rng(0).uniform(-26, 26, (500, 3))
    upper = points_mm[:, 2] > 6
    share = seen_at(slices, points_mm)
    assert (share > 0.5).mean() > 0.99
    assert share[upper].mean() > 0.95
    assert seen_at(slices, points_mm + np.array([0, 0, 50]))[upper].max() == 0


@pytest.mark.parametrize(("coarse_mm", "fine_mm"), [(2.0, 0.5), (1.0, 1.0), (0.5, 2.0)])
def test_what_one_stack_saw_is_seen_whatever_the_pixels_of_another(coarse_mm: float, fine_mm: float) -> None:
    whole, height = np.arange(-27.0, 30, 4), np.arange(-29.0, 30, 2)
    slices = box_stacks((SAGITTAL, coarse_mm, whole), (np.eye(3), fine_mm, height[np.abs(height) > 12]))
    points_mm = np.random.default_rng(0).uniform(-26, 26, (500, 3)) * [1, 1, 0.25]
    share = seen_at(slices, points_mm)
    assert (share > 0.5).mean() > 0.99
    assert share.mean() > 0.95


def test_sampled_is_zero_outside() -> None:
    grid = VolumeGrid((2, 2, 2), np.diag([2.0, 2.0, 2.0, 1.0]))
    volume = np.arange(8, dtype=np.float32).reshape(2, 2, 2)
    assert sampled(volume, grid, np.array([[2.0, 0, 0], [1.0, 0, 0], [9.0, 0, 0]])).tolist() == [4, 2, 0]


def test_half_stacks_overlap_in_part_and_correlate_at_true_poses(still_slices: tuple[Slices, RigidPose]) -> None:
    slices = still_slices[0]
    halves = upper_halves_gone(slices)
    whole = overlap_of(slices, StackSamples.of_all(slices), RigidPose.identity(len(slices)))
    still = RigidPose.identity(len(halves))
    samples = StackSamples.of_all(halves)
    found = overlap_of(halves, samples, still)
    assert min(whole.stack_share) > 0.95
    assert all(0.3 < share < 0.95 for share in found.stack_share)
    assert min(found.correlation) > 0.7
    n = len(samples[0].rows)
    turned = RigidPose(np.tile(rotation_matrix(np.array([0.0, 0.0, np.pi])), (n, 1, 1)), np.zeros((n, 3)))
    assert overlap_of(halves, samples, still.with_rows(samples[0].rows, turned)).correlation[0] < 0.5
    assert all(one.is_cut for one in area_profiles(halves))


@pytest.fixture
def holed(still_slices: tuple[Slices, RigidPose]) -> Slices:
    """One stack without four slices in its middle."""
    slices = still_slices[0].take(still_slices[0].stack_id == 0)
    middle = len(slices) // 2
    return slices.take(np.setdiff1d(np.arange(len(slices)), np.arange(middle - 2, middle + 2)))


def test_spans_keep_the_length_of_the_header(holed: Slices) -> None:
    behind = np.arange(len(holed)) >= np.flatnonzero(np.diff(holed.slice_index) > 1)[0] + 1
    normal, in_plane = holed.header_pose.rotation[0, :, 2], holed.header_pose.rotation[0, :, 0]
    jump = np.where(behind[:, None], -5 * normal + 3 * in_plane, 0)
    motion = RigidPose(np.tile(np.eye(3), (len(holed), 1, 1)), jump)
    found = with_header_spans(holed.header_pose, motion, holed.slice_index)
    assert found.translation_mm @ normal == pytest.approx(0, abs=1e-9)
    assert found.translation_mm @ in_plane == pytest.approx(3 * behind)


def test_whole_stacks_keep_their_motion(still_slices: tuple[Slices, RigidPose]) -> None:
    slices = still_slices[0].take(still_slices[0].stack_id == 1)
    rng = np.random.default_rng(0)
    motion = RigidPose(rotation_matrix(rng.normal(0, 0.1, (len(slices), 3))), rng.normal(0, 3, (len(slices), 3)))
    found = with_header_spans(slices.header_pose, motion, slices.slice_index)
    assert (found.translation_mm == motion.translation_mm).all()


def test_the_tie_of_unseen_slices_is_along_the_normal(holed: Slices) -> None:
    volume, grid = volume_without(holed, -1, 3.2)
    equations = SampledSlices(holed, volume, grid).evaluate(holed.planes, np.ones(len(holed)), 0.1)
    usual = NeighbourTie.of(holed, equations).precision
    held = NeighbourTie.of(holed, equations, np.linspace(0, 1, len(holed))).precision
    assert (held[:, :5] == usual[:, :5]).all()
    assert (np.diff(held[:, 5]) > 0).all()
