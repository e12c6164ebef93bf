"""The number of Gaussians as a result: few for what is simple, as many as the bound asks for elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from g3r.fitting.adaptive_stage import AdaptiveSettings, Densification, fit_adaptive
from g3r.fitting.prior_stage import PriorStageSettings
from g3r.gaussians.cloud import GaussianCloud
from g3r.geometry import VolumeGrid

GRID = VolumeGrid.isotropic([-14.0] * 3, [14.0] * 3, 1.0)
INDEX = np.stack(np.meshgrid(*[np.arange(n) for n in GRID.shape], indexing="ij"), -1)
BALL = ((INDEX - 14.0) ** 2).sum(-1) < 13.0**2
SHEETS = (0.6 + 0.3 * np.tanh(3 * np.sin(INDEX[..., 0] * 0.7)) * (INDEX[..., 2] > 14)).astype(np.float32)
STAGE = PriorStageSettings(n_steps=15, scale_weight=0.0)
QUICK = AdaptiveSettings(bound=0.08, round_steps=15, n_rounds=5)


def fitted(
    bound: float = 0.08, volume: np.ndarray = SHEETS, mask: np.ndarray = BALL, finest_mm: float = 2.0
) -> tuple[GaussianCloud, Densification]:
    settings = replace(QUICK, bound=bound)
    return fit_adaptive(
        volume, mask, GRID, finest_spacing_mm=finest_mm, settings=settings, stage=STAGE, rng=np.random.default_rng(3)
    )


def test_tighter_bounds_need_more_gaussians_and_leave_less() -> None:
    loose, rough = fitted(0.15)
    tight, fine = fitted(0.06)
    assert len(loose) < len(tight)
    assert rough.rms < 0.15
    assert fine.rms < min(0.06, rough.rms)
    assert fine.share_over_bound < 0.1
    for cloud, done in ((loose, rough), (tight, fine)):
        assert len(cloud) == done.n_seeded + done.n_added - done.n_dropped - done.n_merged


def test_gaussians_are_added_where_the_structure_is() -> None:
    """A volume with structure in its upper half has more Gaussians there than a flat one."""
    counts = []
    for volume in (SHEETS, np.full(GRID.shape, 0.6, np.float32)):
        cloud, _ = fitted(0.06, volume)
        third = GRID.index(cloud.mean_mm.double().numpy() + cloud.origin_mm)[:, 2]
        counts.append(int((third > 14).sum()))
    assert counts[0] > 1.5 * counts[1]


def test_same_seed_same_cloud() -> None:
    first, second = fitted()[0], fitted()[0]
    for a, b in zip(first.parameters, second.parameters, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_a_constant_needs_few() -> None:
    """Next to nothing: a few at the rim, where the coarse lattice ends in steps."""
    cloud, done = fitted(volume=np.full(GRID.shape, 0.7, np.float32))
    assert len(cloud) < 100
    assert done.share_over_bound == 0


def test_masks_of_nothing_and_of_one_voxel() -> None:
    with pytest.raises(ValueError, match="foreground is empty"):
        fitted(mask=np.zeros_like(BALL))
    with pytest.raises(ValueError, match="bound"):
        fitted(bound=0.0)
    one = np.zeros_like(BALL)
    one[14, 14, 14] = True
    cloud, done = fitted(mask=one)
    assert all(torch.isfinite(p).all() for p in cloud.parameters)
    assert np.isfinite(done.rms)
