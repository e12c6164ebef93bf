"""Heads shared by the registration tests; making them takes longer than most of the tests."""

import pytest

from data_synth.heads import PhantomSubject
from data_synth.motion import LEVELS
from data_synth.phantom import Phantom, fetal_brain_phantom
from data_synth.simulator import SimulatedStack
from data_synth.template import atlas_templates
from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration import RegistrationSettings, register
from g3r.registration.similarity import StackSamples
from tests.registration.moving_heads import Moving, as_slices, simulated


@pytest.fixture(scope="session")
def head() -> Phantom:
    return fetal_brain_phantom(24, 1.2)


@pytest.fixture(scope="session")
def still(head: Phantom) -> list[SimulatedStack]:
    """Three stacks of a head without motion, without noise."""
    return simulated(head)


@pytest.fixture(scope="session")
def still_slices(still: list[SimulatedStack]) -> tuple[Slices, RigidPose]:
    """The still stacks as slices, and their true motions, which are identities."""
    return as_slices(still)


@pytest.fixture(scope="session")
def samples(still_slices: tuple[Slices, RigidPose]) -> list[StackSamples]:
    """The stack samples of the still slices."""
    return StackSamples.of_all(still_slices[0])


@pytest.fixture(scope="session")
def template() -> AtlasTemplate:
    """Atlas templates of other phantoms, of similar and higher age."""
    subjects = [PhantomSubject(f"week-{w}-{seed}", w, seed) for w in (24.0, 31.0) for seed in (1, 2, 3)]
    return atlas_templates(subjects, 3.0, weeks=(24, 31))


@pytest.fixture(scope="session")
def moving(head: Phantom, template: AtlasTemplate) -> Moving:
    """Severe motion with all layers of registration: walks, four jerks per stack, stacks 25 degrees per axis apart."""
    stacks = simulated(head, LEVELS["severe"], seed=2)
    slices, truth = as_slices(stacks)
    calls: list[tuple[int, int]] = []
    estimate = register(
        slices,
        RegistrationSettings(n_rounds=4, finest_voxel_mm=1.8),
        lambda done, total: calls.append((done, total)),
        template=template,
    )
    return Moving(stacks, slices, truth, estimate, calls)
