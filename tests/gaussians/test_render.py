"""Small, empty and extreme scenes; cut-off, overlap lists, threads, options."""

from typing import Any

import numba
import numpy as np
import pytest
import torch

from g3r.acquisition.planes import Planes
from g3r.gaussians import GaussianCloud, find_overlaps, render
from g3r.geometry import RigidPose
from tests.gaussians.scenes import make_cloud, make_planes, single
from tests.gradients import gradient_of


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_no_gaussian_renders_zero(backend: str) -> None:
    cloud, planes = single(make_cloud(12, 0)), make_planes(12)
    pixels = render(cloud, planes, backend=backend)
    assert pixels.shape == (planes.n_pixels,)
    assert (pixels == 0).all()


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_no_plane_renders_nothing(backend: str) -> None:
    assert render(single(make_cloud(13, 3)), make_planes(13).take([]), backend=backend).shape == (0,)


def test_planes_that_meet_no_gaussian_are_zero_and_the_others_unharmed() -> None:
    cloud, planes = single(make_cloud(15, 10)), make_planes(15)
    away = planes.moved(RigidPose.from_rotvec([[0.0, 0, 0]], [[500.0, 0, 0]]))
    fields = planes.__dataclass_fields__
    both = Planes(**{f: np.concatenate([getattr(p, f) for p in (away, planes)]) for f in fields})
    pixels = render(cloud, both)
    assert (pixels[: away.n_pixels] == 0).all()
    torch.testing.assert_close(pixels[away.n_pixels :], render(cloud, planes), rtol=1e-6, atol=1e-7)
    assert len(find_overlaps(cloud, away, 3.2)) == 0


@pytest.mark.parametrize("log_scale", [[-3.9, -3.9, -3.9], [4.6, 4.6, 4.6], [-3.5, 3.4, 0.0]])
@pytest.mark.parametrize("psf", [0.0, 1.0])
def test_extreme_shapes_agree_with_the_reference_and_have_finite_gradients(log_scale: list[float], psf: float) -> None:
    """Sigma 0.02 and 100 mm, and an axis ratio of 1000."""
    base, planes = make_cloud(16, 5, spread_mm=0.2), make_planes(16, psf=psf, shape=(15, 15))
    cloud = GaussianCloud.of(
        [base.mean_mm, torch.tensor([log_scale] * 5).double(), *base.parameters[2:]], base.origin_mm
    )
    expected = render(cloud, planes, backend="reference")
    leaves = [p.float().requires_grad_() for p in cloud.parameters]
    twist = torch.zeros(len(planes), 6, requires_grad=True)
    found = render(GaussianCloud.of(leaves, cloud.origin_mm), planes, twist=twist, cutoff_sigma=6.0)
    # float32 means are off by 1e-8 mm, at sigma 0.02 mm a relative 1e-6 times the distance in sigmas
    assert (found.detach() - expected).abs().max() < 1e-4 * max(1e-6, float(expected.abs().max()))
    found.square().sum().backward()
    assert all(torch.isfinite(gradient_of(leaf)).all() for leaf in (*leaves, twist))


def test_large_and_slanted_ellipses_of_several_strips_agree_with_the_reference() -> None:
    """Planes are many times wider than the sixteen pixels of a strip, and ellipses are cut by every border."""
    base = make_cloud(24, 12, spread_mm=15)
    rng = np.random.default_rng(24)
    cloud = GaussianCloud.of(
        [base.mean_mm, torch.tensor(np.log(rng.uniform([0.3, 1, 4], [1, 4, 15], (12, 3)))), *base.parameters[2:]],
        base.origin_mm,
    )
    for psf in (0.0, 1.0):
        planes = make_planes(24, n=4, shape=(70, 61), psf=psf)
        expected = render(cloud, planes, backend="reference").numpy()
        found = render(single(cloud), planes, cutoff_sigma=6.0).numpy()
        assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.parametrize("cutoff", [2.0, 3.2, 4.5])
def test_the_cut_off_bounds_the_error(cutoff: float) -> None:
    """The error of a pixel per Gaussian is at most its observed height times exp(-cutoff^2 / 2)."""
    cloud, planes = make_cloud(17, 20), make_planes(17, shape=(25, 25))
    exact = render(cloud, planes, backend="reference").numpy()
    found = render(single(cloud), planes, cutoff_sigma=cutoff).numpy()
    heights = render(cloud.with_amplitude(cloud.amplitude.abs()), planes, backend="reference")
    assert heights.min() >= 0
    bound = float(cloud.amplitude.abs().sum()) * np.exp(-0.5 * cutoff**2) + 1e-6
    error = np.abs(found - exact).max()
    assert error < bound
    assert error > 1e-4 * bound  # the cut-off has an effect


def test_overlap_lists_with_a_margin_give_the_same_pixels_and_stay_valid() -> None:
    cloud, planes = single(make_cloud(18, 60, spread_mm=8)), make_planes(18, shape=(12, 12))
    tight, wide = find_overlaps(cloud, planes, 3.2), find_overlaps(cloud, planes, 4.2)
    assert len(tight) < len(wide)
    assert (np.diff(wide.start) >= np.diff(tight.start)).all()
    plain = render(cloud, planes)
    assert torch.equal(render(cloud, planes, overlaps=tight), plain)
    assert torch.equal(render(cloud, planes, overlaps=wide), plain)
    moved = GaussianCloud.of([cloud.mean_mm + 0.3, *cloud.parameters[1:]], cloud.origin_mm)
    assert torch.equal(render(moved, planes, overlaps=wide), render(moved, planes))


def test_two_thread_counts_agree() -> None:
    most = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    if most < 2:
        pytest.skip("numba was started with one thread")
    cloud, planes = make_cloud(19, 200, spread_mm=6), make_planes(19, n=9, shape=(20, 20))
    before, results = numba.get_num_threads(), []
    try:
        for n_threads in (1, 2):
            numba.set_num_threads(n_threads)
            leaves = [p.float().requires_grad_() for p in cloud.parameters]
            pixels = render(GaussianCloud.of(leaves, cloud.origin_mm), planes)
            pixels.square().sum().backward()
            results.append([pixels.detach(), *(gradient_of(leaf) for leaf in leaves)])
    finally:
        numba.set_num_threads(before)
    for one, two in zip(*results, strict=True):
        assert (one - two).norm() <= 1e-5 * one.norm()


@pytest.mark.parametrize(
    "options",
    [
        {"backend": "cuda"},
        {"attenuation": "wrong"},
        {"cutoff_sigma": 0.0},
        {"cutoff_sigma": 6.5},
        {"cutoff_sigma": float("nan")},
    ],
)
def test_unknown_options_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="expected"):
        render(single(make_cloud(20, 2)), make_planes(20), **options)
