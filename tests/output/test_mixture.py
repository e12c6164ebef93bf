"""The written volume with a correction on voxels: exact on its own grid, interpolated on others, within the support."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from g3r.geometry import VolumeGrid
from g3r.output.mixture import Mixture
from tests.fitting.scene import BALL, GRID, INDEX, true_cloud, true_volume

SLOPE = (0.01 * INDEX[..., 0]).astype(np.float16)
MIXTURE = Mixture(
    grid=GRID,
    support=BALL,
    prior=true_volume(),
    density=np.where(INDEX[..., 2] > 4, 3, 0).astype(np.float32),
    prior_grid=GRID,
    least_weight=0.2,
    edge=BALL.astype(np.float16),
    cutoff_sigma=3.0,
    correction=SLOPE,
)


def added(grid: VolumeGrid) -> np.ndarray:
    """The added correction on a grid."""
    without = replace(MIXTURE, correction=None)
    return MIXTURE.volume(true_cloud(), grid) - without.volume(true_cloud(), grid)


def test_it_is_added_where_the_volume_is_shown() -> None:
    found = added(GRID)
    np.testing.assert_allclose(found[BALL], SLOPE[BALL], atol=1e-6)
    assert not found[~BALL].any()
    mixed = replace(MIXTURE, correction=None).volume(true_cloud(), GRID)
    np.testing.assert_array_equal(MIXTURE.corrected(mixed, GRID), MIXTURE.volume(true_cloud(), GRID))


def test_the_whole_volume_fades_at_the_edge() -> None:
    faded = replace(MIXTURE, edge=(0.25 * BALL).astype(np.float16))
    np.testing.assert_allclose(faded.volume(true_cloud(), GRID), 0.25 * MIXTURE.volume(true_cloud(), GRID), atol=1e-6)


def test_on_another_grid_it_is_interpolated() -> None:
    fine = VolumeGrid.isotropic([-4.3] * 3, [4.1] * 3, 0.6)
    expected = 0.01 * GRID.index(fine.world(np.moveaxis(np.indices(fine.shape), 0, -1)))[..., 0]
    np.testing.assert_allclose(added(fine), expected, atol=2e-4)  # float16


def test_it_does_not_reach_what_no_slice_saw_nor_beyond_the_support() -> None:
    reach = MIXTURE.reach()
    assert reach.dtype == np.float32
    assert not reach[INDEX[..., 2] <= 4].any()
    assert not reach[~BALL].any()
    assert reach[BALL & (INDEX[..., 2] > 4)].min() > 0.9


def test_the_prior_alone_is_not_corrected() -> None:
    nothing = true_cloud().take(torch.zeros(0, dtype=torch.int64))
    assert MIXTURE.volume(nothing, GRID) == pytest.approx(true_volume() * BALL)
