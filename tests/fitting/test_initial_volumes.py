"""Initial volumes of a fit: density of whole slices and of masked pixels, and room for a cut-off head."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from g3r.acquisition.coarse_volume import coarse_and_density
from g3r.acquisition.coverage import coverage
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack
from g3r.fitting.initial_volumes import CUT_OFF_MM, MARGIN_MM, InitialVolumes
from g3r.fitting.least_squares_volume import least_squares_volume
from g3r.fitting.prior_volume import placed_template, prior_volume
from g3r.prior.maps import Tiling
from g3r.registration.atlas_frame import Orientation
from tests.checkpoints.altered_files import small_prior

RADIUS_MM = 20.0


def slices_of_a_ball(missing: slice = slice(0, 0)) -> Slices:
    """One stack of a ball, some of whose slices are blank; intensities far from 1."""
    shape, spacing = (40, 40, 20), np.array([1.5, 1.5, 3.0])
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = -(np.array(shape) - 1) / 2 * spacing
    index = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1)
    world = index @ affine[:3, :3] + affine[:3, 3]
    mask = np.linalg.norm(world, axis=-1) < RADIUS_MM
    image = (700 + 100 * np.sin(world[..., 0] / 5) + 3 * world[..., 1]).astype(np.float32)
    image[:, :, missing], mask[:, :, missing] = 0, False
    return slices_from_stacks([Stack(image=image, mask=mask, affine=affine, thickness_mm=3.0)])


def volumes_of(slices: Slices, box: tuple[np.ndarray, np.ndarray] | None = None) -> InitialVolumes:
    ones = np.ones(len(slices))
    return InitialVolumes.of(slices, ones, ones, 2.0, box)


@pytest.fixture(scope="module")
def missing() -> InitialVolumes:
    """Initial volumes of a ball with a missing slab."""
    return volumes_of(slices_of_a_ball(slice(11, 14)))


def world_of(volumes: InitialVolumes) -> np.ndarray:
    grid = volumes.grid
    return grid.world(np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), -1))


def test_density_is_of_whole_slices_and_the_fit_s_of_masked_pixels(missing: InitialVolumes) -> None:
    slices, grid = slices_of_a_ball(slice(11, 14)), missing.grid
    np.testing.assert_allclose(missing.density, coverage(slices, grid), atol=1e-6)
    np.testing.assert_allclose(missing.masked_density, coarse_and_density(slices, grid)[1], atol=1e-6)
    radius = np.linalg.norm(world_of(missing), axis=-1)
    seen = missing.density > 0.9
    assert missing.share[seen & (radius < 0.8 * RADIUS_MM)].min() > 0.85
    assert missing.share[seen & (radius > 1.2 * RADIUS_MM)].max() < 0.02
    assert np.percentile(missing.coarse[missing.masked_density > 0.1], 99) == pytest.approx(1, abs=1e-3)
    assert missing.foreground.out_of_reach.any()


def test_the_grid_has_room_for_a_head_that_was_cut_off() -> None:
    slices = slices_of_a_ball()
    plain = volumes_of(slices)
    low, high = plain.grid.world([0, 0, 0]), plain.grid.world(np.array(plain.grid.shape) - 1)
    near = np.full(3, CUT_OFF_MM - 1)
    same = volumes_of(slices, (low + MARGIN_MM - near, high - MARGIN_MM + near))
    assert same.grid.shape == plain.grid.shape
    np.testing.assert_allclose(same.grid.affine, plain.grid.affine)
    far = high - MARGIN_MM + near + [0, 0, 15]
    larger = volumes_of(slices, (low + MARGIN_MM, far)).grid
    top = larger.world(np.array(larger.shape) - 1)
    assert far[2] + MARGIN_MM - 0.01 <= top[2] < far[2] + MARGIN_MM + 2.01
    np.testing.assert_allclose(larger.world([0, 0, 0]), low, atol=1.01)
    np.testing.assert_allclose(top[:2], high[:2], atol=1.01)
    np.testing.assert_allclose(larger.spacing_mm, 2.0)
    # never smaller
    inner = volumes_of(slices, (0 * low, 0 * high)).grid
    assert inner.shape == plain.grid.shape


def test_without_a_network_the_prior_volume_is_v_sharp_smoothly_continued(missing: InitialVolumes) -> None:
    gain = np.ones(len(missing.slices))
    made = prior_volume(missing, gain, gain, None, None, n_views=1, tiling=Tiling())
    assert made.brain is None
    assert not made.has_template
    dense = missing.density > 0.5
    np.testing.assert_allclose(made.values[dense], missing.sharp[dense], atol=1e-6)
    other = prior_volume(missing, gain, gain, None, None, n_views=1, tiling=Tiling(), least_squares=True)
    found = least_squares_volume(missing, other.support, gain, gain)
    np.testing.assert_allclose(other.values[dense], found[dense], atol=1e-6)
    unseen = made.mask & missing.foreground.out_of_reach
    assert unseen.sum() > 200
    brain = made.mask & ~missing.foreground.out_of_reach
    assert made.values[unseen].mean() == pytest.approx(made.values[brain].mean(), rel=0.15)
    # the hull closes the gap
    radius = np.linalg.norm(world_of(missing), axis=-1)
    assert made.mask[radius < 0.85 * RADIUS_MM].all()
    assert made.support[radius < 0.9 * RADIUS_MM].all()
    assert not made.mask[radius > 1.2 * RADIUS_MM].any()


def test_a_template_is_placed_only_in_the_atlas_frame() -> None:
    prior = small_prior()
    assert placed_template(prior, None) is None
    assert placed_template(None, None) is None
    slices = slices_of_a_ball()
    orientation = Orientation(pose=slices.planes.pose, correlation=0.9, weeks=30.0, scale=1.1)
    placed = placed_template(prior, orientation)
    assert placed is not None
    np.testing.assert_array_equal(placed.volume, prior.template.volume[1])
    np.testing.assert_allclose(placed.grid.spacing_mm, 1.1 * prior.template.grid.spacing_mm)
    without = replace(prior.network.config, use_template=False)
    prior.network.config = without
    assert placed_template(prior, orientation) is None
