"""A single stack is registered to the template in segments if this is a gain and the template resembles the head."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from data_synth.heads import PhantomSubject
from data_synth.motion import MotionLevel
from data_synth.phantom import Phantom
from data_synth.template import atlas_templates
from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.registration import RegistrationSettings
from g3r.registration.global_search import search_single
from g3r.registration.similarity import StackSamples
from tests.registration.moving_heads import STILL, as_slices, pixel_errors_mm, simulated

JERK = MotionLevel(n_jerks=1, jerk_deg=25.0, jerk_mm=10.0)


@pytest.fixture(scope="module")
def own_template() -> AtlasTemplate:
    """The head itself as a template of its age."""
    return atlas_templates([PhantomSubject("the head", 24.0, 0)], 3.0, weeks=(24,))


@pytest.fixture(scope="module")
def other_template(own_template: AtlasTemplate) -> AtlasTemplate:
    """A template with the same outline but different anatomy."""
    inside = own_template.volume > 0
    blobs = gaussian_filter(np.random.default_rng(0).random(inside.shape), (0, 1, 1, 1))
    blobs = 0.6 + 0.3 * (blobs - blobs[inside].mean()) / blobs[inside].std()
    return replace(own_template, volume=np.where(inside, blobs, 0).astype(np.float32))


def test_a_jerk_is_undone_in_a_template_of_the_head(head: Phantom, own_template: AtlasTemplate) -> None:
    slices, truth = as_slices(simulated(head, JERK, n_stacks=1, seed=2))
    found = search_single(slices, StackSamples.of_all(slices)[0], RegistrationSettings(), own_template)
    assert found.initialisation == "template"
    before, after = (pixel_errors_mm(one, truth).mean() for one in (slices, slices.with_motion(found.motion)))
    assert after < 0.5 * before


def test_segments_in_a_template_that_does_not_show_the_head_are_not_believed(
    head: Phantom, other_template: AtlasTemplate
) -> None:
    slices, _ = as_slices(simulated(head, JERK, n_stacks=1, seed=2))
    found = search_single(slices, StackSamples.of_all(slices)[0], RegistrationSettings(), other_template)
    assert found.initialisation == "headers"


def test_a_still_stack_stays_in_one_piece(head: Phantom, own_template: AtlasTemplate) -> None:
    slices, truth = as_slices(simulated(head, STILL, n_stacks=1, seed=2))
    found = search_single(slices, StackSamples.of_all(slices)[0], RegistrationSettings(), own_template)
    assert found.initialisation == "headers"
    assert pixel_errors_mm(slices.with_motion(found.motion), truth).max() < 1e-6
