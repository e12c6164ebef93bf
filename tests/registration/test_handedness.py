"""Handedness: a mirrored stack is distinguished from one that is not, whatever else is wrong with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data_synth.phantom import Phantom
from data_synth.simulator import SimulatedStack
from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration import RegistrationSettings, register
from g3r.registration.handedness import Asymmetry, antisymmetric_correlation, handedness
from g3r.registration.thresholds import LEAST_SHARE, MIRRORED_BELOW
from tests.registration.moving_heads import Moving, as_slices, simulated, slices_disturbed


@pytest.fixture(scope="module")
def mirrored(head: Phantom) -> list[SimulatedStack]:
    """The stacks of the head with left and right swapped, in the same places."""
    assert np.allclose(
        head.affine[:3, 3], -head.affine[:3, :3] @ (np.array(head.t2.shape) - 1) / 2
    )  # x = 0 is the middle of the grid
    return simulated(replace(head, t2=head.t2[::-1], mask=head.mask[::-1]))


def found(stacks: list[SimulatedStack], seed: int = 0, *, mm: float = 0.0) -> list[float]:
    slices = as_slices(stacks)[0]
    of_stacks = handedness(slices_disturbed(slices, mm, mm, seed), np.ones(len(slices)))
    assert all(one is not None for one in of_stacks)
    return [one for one in of_stacks if one is not None]


@pytest.mark.parametrize("mm", [0.0, 0.4])
def test_stacks_of_one_head_have_its_hand(still: list[SimulatedStack], mm: float) -> None:
    assert min(found(still, mm=mm)) > 0.05


@pytest.mark.parametrize("which", [0, 1, 2])
@pytest.mark.parametrize("mm", [0.0, 0.4])
def test_the_mirrored_one_of_three_is_found(
    still: list[SimulatedStack], mirrored: list[SimulatedStack], which: int, mm: float
) -> None:
    of_stacks = found([mirrored[n] if n == which else one for n, one in enumerate(still)], mm=mm)
    assert np.argmin(of_stacks) == which
    assert of_stacks[which] < MIRRORED_BELOW
    assert min(one for n, one in enumerate(of_stacks) if n != which) > 0.05  # as without the mirrored stack


def test_two_stacks_cannot_tell(still: list[SimulatedStack], mirrored: list[SimulatedStack]) -> None:
    slices = as_slices([still[0], mirrored[1]])[0]
    assert handedness(slices, np.ones(len(slices))) == [None, None]


def test_a_head_that_is_mirrored_as_a_whole_agrees_with_itself(mirrored: list[SimulatedStack]) -> None:
    assert min(found(mirrored)) > 0.05


def test_gains_and_brightness_do_not_count(still: list[SimulatedStack]) -> None:
    slices = as_slices(still)[0]
    gain = np.exp(np.random.default_rng(0).normal(0, 0.2, len(slices)))
    brighter = replace(slices, value=(slices.value * 5 * gain[slices.planes.plane_id()]).astype(np.float32))
    plain, scaled = handedness(slices, np.ones(len(slices))), handedness(brighter, gain)
    assert scaled == pytest.approx(plain, abs=0.01)


def test_nothing_is_said_of_a_stack_that_shows_something_else(still: list[SimulatedStack]) -> None:
    slices = as_slices(still)[0]
    rng, of_one = np.random.default_rng(0), slices.stack_id[slices.planes.plane_id()] == 1
    value = np.where(of_one, rng.uniform(0, 1, slices.value.shape), slices.value).astype(np.float32)
    noise = handedness(replace(slices, value=value), np.ones(len(slices)))
    assert noise[1] is None


def test_what_the_others_saw_on_one_side_alone_is_no_mirror_image(still: list[SimulatedStack]) -> None:
    """Beyond the last slice of the others their volume is zero, which makes pixels resemble the other side more."""
    slices = as_slices(still)[0]
    across = np.abs(slices.planes.rotation[:, 0, 2]) > 0.9  # sagittal slices
    first = slices.stack_id == slices.stack_id[~across][0]
    halved = slices.take(first | (slices.planes.center_mm[:, 0] < 12))
    of_first = handedness(halved, np.ones(len(halved)))[0]
    assert of_first is not None
    assert of_first > 0.05


LOW = Asymmetry(-0.08, 0.03, -0.3)
CLEAR = Asymmetry(0.1, 0.02, 0.4)
NOT_SAID = [None, CLEAR.highest, CLEAR.highest]


@pytest.mark.parametrize(
    ("one", "others", "hands"),
    [
        (LOW, [Asymmetry(0.08, 0.02, 0.3), CLEAR], [LOW.highest, 0.1, 0.12]),
        (LOW, [Asymmetry(0.08, 0.02, LEAST_SHARE), CLEAR], NOT_SAID),
        (Asymmetry(-0.051, 0.018, -0.3), [Asymmetry(0.043, 0.016, 0.3), Asymmetry(0.036, 0.02, 0.3)], NOT_SAID),
        (Asymmetry(-0.09, 0.05, -0.3), [Asymmetry(0.08, 0.02, 0.3), CLEAR], NOT_SAID),
        (LOW, [None, None], NOT_SAID),
        (Asymmetry(-0.03, 0.02, -0.3), [CLEAR, CLEAR], [-0.01, 0.12, 0.12]),
    ],
    ids=[
        "mirrored",
        "symmetric head",
        "hardly unlike the others",
        "hardly below zero",
        "nothing known of the others",
        "above the limit",
    ],
)
def test_a_mirror_image_is_called_so_where_the_others_show_that_the_head_has_sides(
    still: list[SimulatedStack],
    monkeypatch: pytest.MonkeyPatch,
    one: Asymmetry,
    others: list[Asymmetry | None],
    hands: list[float | None],
) -> None:
    def of_stack(slices: Slices, stack: int, rng: np.random.Generator) -> Asymmetry | None:
        if stack == 0:
            return one
        return CLEAR if slices.n_stacks > 2 else others[stack - 1]

    monkeypatch.setattr("g3r.registration.handedness._of_stack", of_stack)
    slices = as_slices(still)[0]
    assert handedness(slices, np.ones(len(slices))) == [None if hand is None else pytest.approx(hand) for hand in hands]


@pytest.mark.parametrize("spread", [0.0, 0.6])
def test_slices_that_do_not_agree_say_less(spread: float) -> None:
    """The standard error comes from leaving out each slice in turn, and grows with their disagreement."""
    rng, n_slices = np.random.default_rng(0), 12
    plane = np.repeat(np.arange(n_slices), 200)
    here, mirrored, noise = rng.normal(size=(3, len(plane)))
    strength = -0.4 + spread * rng.normal(size=n_slices)[plane]
    value = here + mirrored + strength * (here - mirrored) + noise
    y, a, b = (one.astype(np.float32) for one in (value, here, mirrored))
    found = antisymmetric_correlation(y, a, b, plane)
    both = np.stack([np.ones_like(here), here + mirrored], 1)
    left, odd = (one - both @ np.linalg.lstsq(both, one, rcond=None)[0] for one in (value, here - mirrored))
    without = [np.corrcoef(left[plane != k], odd[plane != k])[0, 1] for k in range(n_slices)]
    error = np.sqrt((n_slices - 1) / n_slices * ((without - np.mean(without)) ** 2).sum())
    assert (error > 0.05) == (spread > 0)
    assert found is not None
    assert found.correlation == pytest.approx(np.corrcoef(left, odd)[0, 1], abs=0.01)
    assert found.error == pytest.approx(error, abs=0.01)
    assert found.highest == found.correlation + found.error


@pytest.mark.parametrize("hand", [1.0, -1.0, 0.3])
@pytest.mark.parametrize("brightness", [1.0, 40.0])
def test_the_share_is_how_much_of_the_sides_a_stack_shows(hand: float, brightness: float) -> None:
    rng = np.random.default_rng(0)
    even, odd, noise = rng.normal(size=(3, 4000))
    value = brightness * (even + hand * odd + 0.2 * noise)
    y, a, b = (one.astype(np.float32) for one in (value, even + odd, even - odd))
    found = antisymmetric_correlation(y, a, b, np.repeat(np.arange(20), 200))
    assert found is not None
    assert found.share == pytest.approx(hand, abs=0.03)


def test_an_even_stack_is_no_error(still: list[SimulatedStack]) -> None:
    slices = as_slices(still)[0]
    assert handedness(replace(slices, value=np.ones_like(slices.value)), np.ones(len(slices))) == [None] * 3


def test_registration_asks_where_it_knows_the_orientation(moving: Moving) -> None:
    assert moving.estimate.orientation is not None
    assert moving.estimate.handedness is not None
    assert len(moving.estimate.handedness) == 3
    assert all(one is None or one > MIRRORED_BELOW for one in moving.estimate.handedness)


def test_it_asks_in_the_frame_of_the_scanner_too(moving: Moving, template: AtlasTemplate) -> None:
    quick = RegistrationSettings(
        network=False, stacks=False, n_rounds=1, finest_voxel_mm=1.8, standard_orientation=False
    )
    found = register(moving.slices, quick, template=template)
    assert found.orientation is None
    assert found.handedness is not None
    assert register(moving.slices, replace(quick, check_handedness=False), template=template).handedness is None


def test_registration_does_not_ask_where_it_does_not(still_slices: tuple[Slices, RigidPose]) -> None:
    quick = RegistrationSettings(network=False, stacks=False, segments=False, n_rounds=1, finest_voxel_mm=1.8)
    assert register(still_slices[0], quick).handedness is None
