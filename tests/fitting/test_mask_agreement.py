"""Correction of found masks by the vote of other stacks and the template."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from g3r.acquisition.atlas_template import PlacedHead
from g3r.acquisition.brain_mask import MaskSource
from g3r.acquisition.slicing import normalised_slices
from g3r.acquisition.stacks import Stack
from g3r.fitting.mask_agreement import MAX_CHANGE, refine_masks
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration import Registration

RADIUS_MM = 22.0
N, SPACING_MM, SLICE_MM = 48, 1.5, 3.0
MOVED = RigidPose.from_rotvec(np.array([[0.1, -0.05, 0.08]]), np.array([[3.0, -2.0, 4.0]]))
"""Motion from the header's world to that of the result."""


def ball(points_mm: np.ndarray) -> np.ndarray:
    return (points_mm**2).sum(-1) < RADIUS_MM**2


def stack(axis: int, source: MaskSource = "automatic") -> Stack:
    """Slices along an axis through a ball; the header has the ball's position before it moved."""
    n_slices = 20
    order = [a for a in range(3) if a != axis] + [axis]
    affine = np.zeros((4, 4))
    affine[3, 3] = 1
    for column, (world, size) in enumerate(zip(order, (SPACING_MM, SPACING_MM, SLICE_MM), strict=True)):
        affine[world, column] = size
    shape = (N, N, n_slices)
    affine[:3, 3] = -affine[:3, :3] @ ((np.array(shape) - 1) / 2)
    world_mm = VolumeGrid(shape, affine).world(np.moveaxis(np.indices(shape), 0, -1))
    image = np.random.default_rng(axis).uniform(0.5, 1.0, shape).astype(np.float32)
    return Stack(
        image=image, mask=ball(world_mm), affine=affine, thickness_mm=SLICE_MM, name=f"{axis}", mask_source=source
    )


def registered(stacks: list[Stack]) -> tuple[Registration, float]:
    slices, intensity = normalised_slices(stacks)
    k, ones = len(slices), np.ones(len(slices))
    motion = RigidPose(np.repeat(MOVED.rotation, k, 0), np.repeat(MOVED.translation_mm, k, 0))
    return Registration(
        slices=slices.with_motion(motion),
        gain=ones,
        weight=ones,
        ncc=ones,
        held_out=None,
        initialisation="headers",
        initialisations={},
        interleave=[None] * len(stacks),
        n_segments=[1] * len(stacks),
        median_move_mm=[0.0] * len(stacks),
        orientation=None,
    ), intensity


def template() -> PlacedHead:
    """A template ball at the place of the moved ball."""
    grid = VolumeGrid.isotropic([-40] * 3, [40] * 3, 2.0)
    world_mm = grid.world(np.moveaxis(np.indices(grid.shape), 0, -1))
    return PlacedHead.of(ball(world_mm - MOVED.translation_mm[0]).astype(np.float32), grid)


def dice(a: np.ndarray, b: np.ndarray) -> float:
    return 2 * np.count_nonzero(a & b) / (np.count_nonzero(a) + np.count_nonzero(b))


def with_a_bite(good: Stack) -> Stack:
    """A mask that lacks a quarter of the brain in some slices and includes surroundings in others."""
    mask = good.mask.copy()
    mask[: N // 2, : N // 2, 8:12] = False
    mask[35:44, 20:30, 5:8] = True
    return replace(good, mask=mask)


@pytest.mark.parametrize("with_template", [True, False])
def test_others_mend_what_one_missed(with_template: bool) -> None:
    good = [stack(axis) for axis in range(3)]
    stacks = [with_a_bite(good[0]), *good[1:]]
    poses, intensity = registered(stacks)
    found = refine_masks(stacks, poses, intensity, template() if with_template else None)
    before, after = dice(stacks[0].mask, good[0].mask), dice(found.stacks[0].mask, good[0].mask)
    assert before < 0.94
    assert after > 0.96
    assert all(dice(new.mask, old.mask) > 0.97 for new, old in zip(found.stacks[1:], good[1:], strict=True))
    assert found.notes[0].startswith("0: its mask was refined")


def test_slices_stay_where_they_are_and_carry_the_new_masks() -> None:
    good = [stack(axis) for axis in range(3)]
    stacks = [with_a_bite(good[0]), *good[1:]]
    poses, intensity = registered(stacks)
    found = refine_masks(stacks, poses, intensity, None)
    before, after = poses.slices, found.poses.slices
    np.testing.assert_array_equal(after.stack_id, before.stack_id)
    np.testing.assert_array_equal(after.slice_index, before.slice_index)
    for name in ("rotation", "translation_mm"):
        np.testing.assert_allclose(
            getattr(after.world_from_header(), name), getattr(before.world_from_header(), name), atol=1e-9
        )
    # header and motion together place masked pixels in the ball
    inside_mm = after.planes.pixel_world_mm(after.pixel_index) - MOVED.translation_mm[0]
    assert np.mean(np.linalg.norm(inside_mm, axis=1) < RADIUS_MM + 3) > 0.98
    first = after.pixel_index[0]
    assert after.value[first] * intensity == pytest.approx(
        found.stacks[0].image[:, :, after.slice_index[0]][found.stacks[0].mask[:, :, after.slice_index[0]]][0], rel=1e-5
    )


def test_what_a_person_drew_stays() -> None:
    good = [stack(axis) for axis in range(3)]
    stacks = [replace(with_a_bite(good[0]), mask_source="file"), *good[1:]]
    poses, intensity = registered(stacks)
    found = refine_masks(stacks, poses, intensity, template())
    np.testing.assert_array_equal(found.stacks[0].mask, stacks[0].mask)


def test_one_against_one_changes_nothing() -> None:
    stacks = [with_a_bite(stack(0)), stack(1)]
    poses, intensity = registered(stacks)
    found = refine_masks(stacks, poses, intensity, None)
    assert [np.array_equal(a.mask, b.mask) for a, b in zip(found.stacks, stacks, strict=True)] == [True, True]
    assert found.notes == []
    alone, intensity = registered(stacks[:1])
    assert refine_masks(stacks[:1], alone, intensity, None).poses is alone


def test_a_mask_that_would_change_too_much_is_kept_and_said() -> None:
    good = [stack(axis) for axis in range(3)]
    far = np.roll(good[0].mask, 12, axis=0)
    stacks = [replace(good[0], mask=far), *good[1:]]
    poses, intensity = registered(stacks)
    found = refine_masks(stacks, poses, intensity, template())
    np.testing.assert_array_equal(found.stacks[0].mask, far)
    assert "stays as it was found" in found.notes[0]
    assert np.count_nonzero(far != good[0].mask) > MAX_CHANGE * np.count_nonzero(far)
