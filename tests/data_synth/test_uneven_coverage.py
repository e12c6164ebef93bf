"""Simulated gaps in coverage: the intended parts are missing, and everything else is unchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("torchio")

from data_synth import uneven_coverage
from data_synth.simulator import SimulatedStack
from data_synth.uneven_coverage import MIN_SLICES, with_uneven_coverage, without_slices
from g3r.acquisition.coverage import coverage
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack
from g3r.geometry import RigidPose, VolumeGrid

SHAPE = (26, 24, 16)
SPACING_MM = np.array([2.0, 2.0, 3.0])


def simulated(seed: int = 0, shape: tuple[int, int, int] = SHAPE) -> SimulatedStack:
    """A stack of a ball in an oblique frame with distinct pixel values, in which every slice moved."""
    index = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1)
    mask = np.linalg.norm((index - (np.array(shape) - 1) / 2) * SPACING_MM, axis=-1) < 20
    affine = np.eye(4)
    affine[:3, :3] = Rotation.random(random_state=seed).as_matrix() * SPACING_MM
    affine[:3, 3] = -affine[:3, :3] @ ((np.array(shape) - 1) / 2)
    image = 1 + np.arange(mask.size, dtype=np.float32).reshape(shape)
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(0.1 * rng.standard_normal((shape[2], 3))).as_matrix()
    return SimulatedStack(
        stack=Stack(image=image, mask=mask, affine=affine, thickness_mm=3.0),
        true_pose=RigidPose(turn, rng.normal(0, 1, (shape[2], 3))),
        gain=np.ones(shape[2]),
        dropout=np.zeros(shape[2], bool),
    )


def settings(monkeypatch: pytest.MonkeyPatch, **values: float) -> None:
    for name, value in values.items():
        monkeypatch.setattr(uneven_coverage, name, value)


@pytest.fixture
def only_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    settings(monkeypatch, EVEN_SHARE=0.0, CUT_SHARE=0.0, BOTH_SHARE=0.0, CONCERNED_SHARE=1.0)


@pytest.fixture
def only_cuts(monkeypatch: pytest.MonkeyPatch) -> None:
    settings(monkeypatch, EVEN_SHARE=0.0, CUT_SHARE=1.0, BOTH_SHARE=0.0, SAME_SIDE_SHARE=1.0)


def placed_back(part: Stack, whole: Stack) -> tuple[np.ndarray, np.ndarray]:
    """Image and mask of a smaller stack at their place in the whole stack; zero elsewhere."""
    np.testing.assert_allclose(part.affine[:3, :3], whole.affine[:3, :3])
    first = np.linalg.inv(whole.affine) @ part.affine[:, 3]
    low = np.round(first[:3]).astype(int)
    np.testing.assert_allclose(first[:3], low, atol=1e-9)
    box = tuple(slice(a, a + n) for a, n in zip(low, part.image.shape, strict=True))
    image, mask = np.zeros_like(whole.image), np.zeros_like(whole.mask)
    image[box], mask[box] = part.image, part.mask
    return image, mask


@pytest.mark.usefixtures("only_missing")
def test_a_run_of_slices_is_missing_and_nothing_else() -> None:
    lengths, first = set(), set()
    for seed in range(60):
        one = simulated()
        (other,) = with_uneven_coverage([one], np.random.default_rng(seed))
        masked = np.flatnonzero(one.stack.mask.any((0, 1)))
        blank = np.flatnonzero(~other.stack.image.any((0, 1)))
        assert set(blank) <= set(masked)
        assert (np.diff(blank) == 1).all()
        assert not other.stack.mask[:, :, blank].any()
        kept = np.setdiff1d(np.arange(SHAPE[2]), blank)
        np.testing.assert_array_equal(other.stack.image[:, :, kept], one.stack.image[:, :, kept])
        np.testing.assert_array_equal(other.stack.mask[:, :, kept], one.stack.mask[:, :, kept])
        assert len(np.flatnonzero(other.stack.mask.any((0, 1)))) >= MIN_SLICES
        lengths.add(len(blank))
        first.add(int(blank[0]))
    assert {uneven_coverage.MISSING_SLICES[0], uneven_coverage.MISSING_SLICES[1]} <= lengths
    assert max(lengths) == uneven_coverage.MISSING_SLICES[1]
    assert len(first) > 5


@pytest.mark.usefixtures("only_missing")
def test_a_stack_of_few_slices_keeps_them() -> None:
    one = simulated()
    mask = one.stack.mask.copy()
    mask[:, :, :6], mask[:, :, 6 + MIN_SLICES :] = False, False
    few = replace(one, stack=replace(one.stack, mask=mask))
    assert with_uneven_coverage([few], np.random.default_rng(0))[0] is few
    nothing_left = without_slices(few, 0, SHAPE[2])
    assert nothing_left is few


@pytest.mark.usefixtures("only_cuts")
def test_a_cut_takes_one_side_of_the_head() -> None:
    """The remaining mask is its intersection with a half-space along one axis, with the requested share cut off."""
    low, high = uneven_coverage.CUT
    sides, along = set(), set()
    for seed in range(40):
        one = simulated(seed)
        (other,) = with_uneven_coverage([one], np.random.default_rng(seed))
        image, mask = placed_back(other.stack, one.stack)
        assert mask.any()
        found = []
        for axis in range(3):
            others = tuple(k for k in range(3) if k != axis)
            before, after = (np.flatnonzero(m.any(others)) for m in (one.stack.mask, mask))
            place = np.arange(SHAPE[axis]).reshape([-1 if k == axis else 1 for k in range(3)])
            for side, inside in ((0, place >= after[0]), (1, place <= after[-1])):
                share = 1 - len(after) / len(before)
                if (mask == (one.stack.mask & inside)).all() and low - 0.04 <= share <= high + 0.04:
                    found.append((axis, side))
                    np.testing.assert_array_equal(image[mask], one.stack.image[mask])
        assert len(found) == 1, (seed, found)
        along.add(found[0][0])
        sides.add(found[0][1])
    assert along == {0, 1, 2}
    assert sides == {0, 1}


@pytest.mark.usefixtures("only_cuts")
def test_poses_keep_their_meaning_after_a_cut() -> None:
    """Remaining pixels keep their true positions, because true poses refer to points by the header."""
    n_smaller = 0
    for seed in range(12):
        one = simulated(seed)
        (other,) = with_uneven_coverage([one], np.random.default_rng(seed))
        assert other.true_pose is one.true_pose
        n_smaller += other.stack.image.shape != SHAPE
        place: list[dict[float, np.ndarray]] = []
        for each in (one, other):
            slices = slices_from_stacks([each.stack])
            moved = slices.with_motion(each.true_pose.take(slices.slice_index))
            world = moved.planes.pixel_world_mm()[moved.mask]
            place.append(dict(zip(moved.value[moved.mask].tolist(), world, strict=True)))
        before, after = place
        assert 200 < len(after) < len(before)
        for value, position in after.items():
            np.testing.assert_allclose(position, before[value], atol=1e-6)
    assert 3 < n_smaller < 12


@pytest.mark.usefixtures("only_cuts")
def test_what_was_cut_off_is_not_covered() -> None:
    grid = VolumeGrid.isotropic([-22] * 3, [22] * 3, 2.0)
    for seed in range(6):
        one = simulated(seed)
        (other,) = with_uneven_coverage([one], np.random.default_rng(seed))
        _, mask = placed_back(other.stack, one.stack)
        density = coverage(slices_from_stacks([other.stack]), grid)
        for part, covered in ((mask, True), (one.stack.mask & ~mask, False)):
            middle = one.stack.affine[:3, :3] @ np.argwhere(part).mean(0) + one.stack.affine[:3, 3]
            at = tuple(np.round(grid.index(middle)).astype(int))
            assert (density[at] > 0.9) is np.bool_(covered)
            assert covered or density[at] < 0.2


def test_shares_are_as_stated() -> None:
    rng = np.random.default_rng(0)
    stacks = [simulated(k, (14, 13, 14)) for k in range(3)]
    n = 400
    untouched, cut = 0, 0
    for _ in range(n):
        result = with_uneven_coverage(stacks, rng)
        assert len(result) == 3
        untouched += all(a is b for a, b in zip(stacks, result, strict=True))
        cut += any(b.stack.image.shape != a.stack.image.shape for a, b in zip(stacks, result, strict=True))
    assert untouched / n == pytest.approx(uneven_coverage.EVEN_SHARE, abs=0.07)
    # half of the incomplete subjects, or one in five, are cut; in plane by two of three directions of any stack
    concerned = (1 - uneven_coverage.EVEN_SHARE) * (1 - (1 - uneven_coverage.CUT_SHARE) * (1 - 0.2))
    assert 0.6 * concerned < cut / n <= concerned + 0.05


def test_it_is_repeatable() -> None:
    stacks = [simulated(k) for k in range(3)]
    one, other = (with_uneven_coverage(stacks, np.random.default_rng(5)) for _ in range(2))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.stack.image, b.stack.image)
        np.testing.assert_array_equal(a.stack.affine, b.stack.affine)
