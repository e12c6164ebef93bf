"""Artefacts inside single slices."""

import numpy as np
import pytest
import torch

pytest.importorskip("torchio")

import torchio as tio

from data_synth import artefacts
from data_synth.artefacts import slice_by_slice, with_artefacts
from data_synth.atlas import TruthVolume
from data_synth.simulator import SimulatedStack, StackSettings, simulate_stacks


@pytest.fixture(scope="module")
def stacks(head: TruthVolume) -> list[SimulatedStack]:
    settings = [StackSettings(resolution_mm=1.5, thickness_mm=4.0, orientation=name) for name in ("axial", "coronal")]
    return simulate_stacks(head.data, head.mask, head.affine, settings, np.random.default_rng(4))


def changed_slices(before: list[SimulatedStack], after: list[SimulatedStack]) -> np.ndarray:
    pairs = zip(before, after, strict=True)
    return np.concatenate([np.abs(a.stack.image - b.stack.image).max((0, 1)) > 0 for a, b in pairs])


def test_a_few_slices_have_an_artefact_and_all_else_stays(stacks: list[SimulatedStack]) -> None:
    result = with_artefacts(stacks, 0.2, np.random.default_rng(1))
    changed = changed_slices(stacks, result)
    assert 0 < changed.sum() < 0.5 * len(changed)
    for one, other in zip(stacks, result, strict=True):
        assert other.stack.image.dtype == np.float32
        assert np.isfinite(other.stack.image).all()
        assert other.stack.image.min() >= 0
        np.testing.assert_array_equal(one.stack.mask, other.stack.mask)
        assert one.true_pose is other.true_pose


def test_none_and_all(stacks: list[SimulatedStack]) -> None:
    assert not changed_slices(stacks, with_artefacts(stacks, 0.0, np.random.default_rng(1))).any()
    assert changed_slices(stacks, with_artefacts(stacks, 1.0, np.random.default_rng(1))).mean() > 0.9


def test_the_generator_decides(stacks: list[SimulatedStack]) -> None:
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    first = with_artefacts(stacks, 0.3, np.random.default_rng(2))
    torch.testing.assert_close(torch.rand(3), expected, rtol=0, atol=0)  # torch's global generator is unchanged
    again = with_artefacts(stacks, 0.3, np.random.default_rng(2))
    assert not changed_slices(first, again).any()
    assert changed_slices(first, with_artefacts(stacks, 0.3, np.random.default_rng(3))).any()


def test_each_slice_of_a_stack_moves_by_itself() -> None:
    one = torch.zeros(24, 20)
    one[6:18, 5:15] = torch.rand(12, 10, generator=torch.Generator().manual_seed(1))
    stack = one[..., None].repeat(1, 1, 4)[None]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(2)
        moved = slice_by_slice(tio.RandomMotion(degrees=4, translation=3))(stack)
    assert moved.shape == stack.shape
    assert float(moved.min()) >= 0
    assert bool(((moved - stack).abs().amax((0, 1, 2)) > 0.05).all())
    assert all(float((moved[..., k] - moved[..., k - 1]).abs().max()) > 0.05 for k in range(1, 4))


def test_motion_rings_within_the_slice(stacks: list[SimulatedStack], monkeypatch: pytest.MonkeyPatch) -> None:
    """A moved copy alone would be dark beside the head; k-space from several poses causes ringing there."""
    monkeypatch.setattr(artefacts, "slice_artefacts", lambda: tio.RandomMotion(degrees=4, translation=3))
    moved = with_artefacts(stacks[:1], 1.0, np.random.default_rng(5))[0].stack
    still = stacks[0].stack
    corner = still.image[:4].mean()  # noise
    k = int(still.mask.sum((0, 1)).argmax())
    columns = np.asarray(still.mask[:, :, k].any(1))
    outside = ~still.mask[:, :, k] & columns[:, None]
    assert still.image[:, :, k][outside].mean() < 3 * corner
    assert moved.image[:, :, k][outside].mean() > 1.3 * still.image[:, :, k][outside].mean()
