"""The prior share: 1 where nothing was measured, small with three stacks, and consistent with refitting."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from g3r.acquisition.coarse_volume import coarse_and_density
from g3r.acquisition.planes import Slices, volume_from_pixels, volume_planes
from g3r.fitting.fit_context import FitContext
from g3r.fitting.prior_stage import PriorStageSettings, VolumeTarget, fit_prior
from g3r.fitting.slice_stage import SliceFit, SliceStageSettings, fit_slices
from g3r.gaussians import GaussianCloud, render
from g3r.geometry import VolumeGrid
from g3r.uncertainty.prior_share import estimate_prior_share
from tests.fitting.scene import BALL, GRID, INDEX, make_slices, seeded, true_volume

UPPER = GRID.world(INDEX)[..., 2] > 2.0
LOWER = GRID.world(INDEX)[..., 2] < -2.0


@pytest.fixture(scope="module")
def volume() -> np.ndarray:
    return true_volume()


def half_measured() -> Slices:
    """Three stacks whose masks are empty above the middle."""
    slices = make_slices()
    return replace(slices, mask=slices.mask & (slices.planes.pixel_world_mm()[:, 2] < 0))


def whole_fit(prior: np.ndarray, slices: Slices) -> tuple[SliceFit, np.ndarray, np.ndarray]:
    """Both stages from a prior volume, and the volumes after the first and after the second."""
    context = FitContext(rng=np.random.default_rng(0))
    whole = VolumeTarget.of(prior, BALL.astype(np.float32), GRID)
    cloud, _ = fit_prior(seeded(prior), whole, PriorStageSettings(n_steps=15), context)
    density = coarse_and_density(slices, GRID)[1]
    target = VolumeTarget.of(prior, (BALL * np.maximum(np.exp(-density), 1e-3)).astype(np.float32), GRID)
    ones = np.ones(len(slices))
    settings = SliceStageSettings(n_steps=40, optimise_poses=False, optimise_bias_field=False)
    fit = fit_slices(cloud, slices, gain=ones, weight=ones, prior=target, settings=settings, context=context)
    return fit, as_volume(cloud), as_volume(fit.cloud)


def as_volume(cloud: GaussianCloud) -> np.ndarray:
    return volume_from_pixels(render(cloud, volume_planes(GRID)).numpy(), GRID)


def share_of(fit: SliceFit, slices: Slices, seed: int = 0) -> np.ndarray:
    density = coarse_and_density(slices, GRID)[1]
    return estimate_prior_share(
        fit, density=density, density_grid=GRID, mask=BALL, grid=GRID, rng=np.random.default_rng(seed)
    )


def test_the_share_is_what_refitting_to_another_prior_says(volume: np.ndarray) -> None:
    slices = half_measured()
    fit, first, last = whole_fit(volume, slices)
    share = share_of(fit, slices)
    assert share.dtype == np.float32
    assert 0 <= share.min() <= share.max() <= 1
    change = gaussian_filter(np.random.default_rng(5).standard_normal(GRID.shape), 1.6)
    change = (0.03 * change / change.std() * BALL).astype(np.float32)
    _, other_first, other_last = whole_fit(volume + change, slices)
    change, answer = other_first - first, other_last - last  # as far as Gaussians can represent the change
    kept = {
        name: float((answer * change)[part].sum() / (change**2)[part].sum())
        for name, part in (("upper", UPPER & BALL), ("lower", LOWER & BALL))
    }
    # the map errs slightly towards the prior
    assert kept["lower"] - 0.03 < share[LOWER & BALL].mean() < kept["lower"] + 0.15
    # without data, a second fit does not repeat every detail, although it rests on the prior alone
    assert kept["upper"] > 0.5
    assert share[UPPER & BALL].mean() > 0.9
    assert (share[~BALL] == 1).all()


def test_fewer_stacks_leave_more_to_the_prior(volume: np.ndarray) -> None:
    three = make_slices()
    fit, _, _ = whole_fit(volume, three)
    shares = []
    for slices in (three, three.take(np.arange(8)), three.take(np.arange(0, 8, 3))):
        part = replace(fit, slices=slices, gain=np.ones(len(slices)), weight=np.ones(len(slices)))
        shares.append(float(share_of(part, slices)[BALL].mean()))
    assert shares[0] < 0.25
    assert shares[0] < shares[1] < shares[2]
    # slices without weight measure nothing
    weightless = replace(fit, weight=np.full(len(three), 1e-9))
    density = np.zeros(GRID.shape, np.float32)
    nothing = estimate_prior_share(
        weightless, density=density, density_grid=GRID, mask=BALL, grid=GRID, rng=np.random.default_rng(0)
    )
    np.testing.assert_allclose(nothing, 1, atol=1e-6)


def test_the_share_is_given_on_any_grid_and_is_repeatable(volume: np.ndarray) -> None:
    slices = make_slices()
    fit, _, _ = whole_fit(volume, slices)
    density = coarse_and_density(slices, GRID)[1]
    fine = VolumeGrid.isotropic([-11] * 3, [11] * 3, 0.7)
    mask = (fine.world(np.stack(np.meshgrid(*[np.arange(n) for n in fine.shape], indexing="ij"), -1)) ** 2).sum(
        -1
    ) < 9.5**2
    given = {"density": density, "density_grid": GRID, "mask": mask, "grid": fine}
    one, two = (estimate_prior_share(fit, **given, rng=np.random.default_rng(3)) for _ in range(2))
    assert one.shape == fine.shape
    np.testing.assert_array_equal(one, two)
    assert one[mask].mean() == pytest.approx(share_of(fit, slices)[BALL].mean(), abs=0.05)
