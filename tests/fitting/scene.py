"""A scene of a few dozen Gaussians in a ball, its volume and its slices."""

from typing import Any

import numpy as np

from g3r.acquisition.planes import Slices, volume_from_pixels, volume_planes
from g3r.fitting.fit_context import FitContext
from g3r.fitting.prior_stage import VolumeTarget
from g3r.fitting.slice_stage import SliceFit, SliceStageSettings, fit_slices
from g3r.gaussians import GaussianCloud, render
from g3r.gaussians.seeding import seed_cloud
from g3r.geometry import VolumeGrid
from tests.gaussians.scenes import cloud_of, slices_of, stack_planes

GRID = VolumeGrid.isotropic([-11] * 3, [11] * 3, 1.0)
INDEX = np.stack(np.meshgrid(*[np.arange(n) for n in GRID.shape], indexing="ij"), -1)
BALL = (GRID.world(INDEX) ** 2).sum(-1) < 9.5**2


def true_cloud() -> GaussianCloud:
    rng = np.random.default_rng(0)
    n = 40
    points = rng.normal(size=(n, 3))
    points *= (8 * rng.random(n) ** (1 / 3) / np.linalg.norm(points, axis=1))[:, None]
    log_scale = np.log(rng.uniform(1.3, 2.6, (n, 3)))
    return cloud_of(points, log_scale, rng.normal(size=(n, 4)), rng.uniform(0.2, 0.6, n))


def true_volume() -> np.ndarray:
    return volume_from_pixels(render(true_cloud(), volume_planes(GRID), cutoff_sigma=6.0).numpy(), GRID)


def make_slices(gain: np.ndarray | None = None) -> Slices:
    """Three stacks of eight slices of the true cloud, with its PSF."""
    planes = stack_planes(8, 2.4, 20)
    value = render(true_cloud(), planes, cutoff_sigma=6.0).numpy()
    if gain is not None:
        value = value * gain[planes.plane_id()].astype(np.float32)
    mask = np.linalg.norm(planes.pixel_world_mm(), axis=1) < 10
    return slices_of(planes, value, mask, 3, 2.4)


def seeded(volume: np.ndarray) -> GaussianCloud:
    return seed_cloud(volume, BALL, GRID, 2.4)


def fit(
    volume: np.ndarray,
    slices: Slices,
    prior: VolumeTarget | None = None,
    gain: np.ndarray | None = None,
    settings: SliceStageSettings | None = None,
    **options: Any,
) -> SliceFit:
    """Stage 2 from seeds in a volume, with 40 steps unless the settings or options say otherwise."""
    ones = np.ones(len(slices))
    return fit_slices(
        seeded(volume),
        slices,
        gain=ones if gain is None else gain,
        weight=ones,
        prior=prior,
        settings=settings or SliceStageSettings(**({"n_steps": 40} | options)),
        context=FitContext(rng=np.random.default_rng(0)),
    )
