"""Extreme scenes: every backend gives finite and correct values and gradients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes
from g3r.acquisition.psf import psf_variance_mm2
from g3r.gaussians import GaussianCloud, find_overlaps, render
from g3r.gaussians.cloud import SIGMA_RANGE_MM
from g3r.geometry import RigidPose
from tests.gradients import gradient_of
from tests.numerics.errors import gradient_tolerance, shape_tolerance, sized_scenes
from tests.numerics.fast_backends import BACKENDS, FAST
from tests.numerics.oracles import volume_at
from tests.numerics.scenes import ORIGIN_MM, Scene, cloud_of, head_scene, single, slender_scenes, stacks_of_planes
from tests.tally import Tally


def of_sigma(sigma_mm: float, thickness_mm: float) -> Scene:
    return sized_scenes(sigma_mm, thickness_mm, 1)[0]


def slender(ratio: float, psf: bool) -> Scene:
    return slender_scenes(ratio, 20.0, psf, 1, 9)[0]


def with_amplitudes(factor: float) -> Scene:
    scene = head_scene()
    return Scene(scene.cloud.with_amplitude(scene.cloud.amplitude * factor), scene.planes)


def with_quaternions(length: float) -> Scene:
    scene = head_scene()
    mean, log_scale, quaternion, amplitude = scene.cloud.parameters
    unit = quaternion / quaternion.norm(dim=1, keepdim=True)
    return Scene(GaussianCloud.of([mean, log_scale, unit * length, amplitude], scene.cloud.origin_mm), scene.planes)


def of_thickness(thickness_mm: float) -> Scene:
    return Scene(head_scene().cloud, stacks_of_planes(ORIGIN_MM, thickness_mm, 4))


def turned(angle_rad: float) -> Scene:
    scene = head_scene()
    axis = np.array([0.6, -0.48, 0.64])
    turn = Rotation.from_rotvec(np.tile(angle_rad * axis, (len(scene.planes), 1))).as_matrix()
    return Scene(scene.cloud, replace(scene.planes, rotation=scene.planes.rotation @ turn))


def identical() -> Scene:
    scene = head_scene()
    return Scene(scene.cloud.take(torch.zeros(50, dtype=torch.long)), scene.planes)


def flat(psf: bool, n: int = 6, tilt_rad: float = 3e-4, aside_mm: float = 0.01) -> Scene:
    """Discs of 100 mm that are 0.02 mm thick, each with a nearly parallel plane at a small distance."""
    rng = np.random.default_rng(5)
    turns = Rotation.random(n, rng=rng)
    cloud = cloud_of(
        rng.normal(0, 2, (n, 3)),
        np.tile([100.0, 100.0, 0.02], (n, 1)),
        np.roll(turns.as_quat(), 1, axis=1),
        rng.uniform(0.2, 1, n),
    )
    tilted = turns * Rotation.from_rotvec(rng.normal(0, tilt_rad, (n, 3)))
    spacing = np.full((n, 2), 4.0)
    aside = turns.apply(np.array([0, 0, aside_mm]) * rng.choice([-1, 1], (n, 1)))
    planes = Planes(
        rotation=tilted.as_matrix(),
        center_mm=ORIGIN_MM + cloud.mean_mm.numpy() + aside,
        spacing_mm=spacing,
        shape=np.full((n, 2), 40),
        psf_var_mm2=psf_variance_mm2(spacing, np.full(n, 0.1)) * (1.0 if psf else 0.0),
    )
    return Scene(cloud, planes)


def apart(distance_mm: float) -> Scene:
    """Planes so far away that they meet no Gaussian."""
    scene, motion = head_scene(), RigidPose.from_rotvec([[0.0, 0, 0]], [[distance_mm, 0, 0]])
    return Scene(scene.cloud, scene.planes.moved(motion))


def astray() -> Scene:
    """A scene in which some Gaussians are seen by no plane."""
    scene = head_scene()
    mean = scene.cloud.mean_mm.clone()
    mean[::3] += 5000.0
    return Scene(GaussianCloud.of([mean, *scene.cloud.parameters[1:]], scene.cloud.origin_mm), scene.planes)


def pixels_of(shape: tuple[int, int], n_planes: int) -> Scene:
    scene = head_scene()
    planes = scene.planes.take(np.arange(4, 4 + n_planes))
    return Scene(scene.cloud, replace(planes, shape=np.tile(shape, (n_planes, 1))))


SCENES: dict[str, tuple[Callable[[], Scene], float]] = {
    **{
        f"sigma {s:g} mm, slices of {t:g} mm": (partial(of_sigma, s, t), 1.5)
        for s in (0.02, 0.3, 100.0)
        for t in (0.0, 0.1, 2.2, 20.0)
    },
    **{f"axis ratio {r:g}{', PSF' * p}": (partial(slender, r, p), r) for r in (30.0, 1000.0) for p in (False, True)},
    "flat discs in V(x)": (lambda: flat(False), 5000.0),
    "flat discs in thin slices": (lambda: flat(True), 5000.0),
    **{f"slices of {t:g} mm": (partial(of_thickness, t), 3.0) for t in (0.1, 20.0)},
    **{f"{d:g} m away": (partial(head_scene, np.array([1, -1, 1.0]) * d * 1e3), 3.0) for d in (0.0, 10.0)},
    **{f"planes turned by {a:g} rad": (partial(turned, a), 3.0) for a in (0.0, 1e-8, np.pi)},
    **{f"quaternions of length {n:g}": (partial(with_quaternions, n), 3.0) for n in (1e-10, 1e10)},
    **{f"amplitudes times {f:g}": (partial(with_amplitudes, f), 3.0) for f in (0.0, 1e-6, 1e6, -1.0)},
    "identical Gaussians": (identical, 3.0),
    "no Gaussian": (lambda: Scene(head_scene().cloud.take(torch.arange(0)), head_scene().planes), 3.0),
    "one Gaussian": (lambda: Scene(head_scene().cloud.take(torch.tensor([0])), head_scene().planes), 3.0),
    "one pixel": (lambda: pixels_of((1, 1), 1), 3.0),
    "one row": (lambda: pixels_of((1, 90), 2), 3.0),
    "one slice": (lambda: pixels_of((28, 28), 1), 3.0),
    "planes beside the Gaussians": (lambda: apart(40.0), 3.0),
    "planes that meet no Gaussian": (lambda: apart(1e4), 3.0),
    "Gaussians outside every plane": (astray, 3.0),
}


@pytest.mark.parametrize("name", SCENES)
def test_value_and_every_gradient_are_finite_and_right(name: str, tally: Tally) -> None:
    make, ratio = SCENES[name]
    scene = make()
    cloud, planes = scene.cloud, scene.planes
    weight = torch.tensor(np.random.default_rng(0).normal(size=planes.n_pixels))
    expected, expected_gradient = BACKENDS["reference64"](cloud, planes, weight)
    height = float(cloud.amplitude.abs().sum())
    largest = float(expected.abs().max()) if len(expected) else 0.0
    assert torch.isfinite(expected).all()
    for backend in BACKENDS:
        with tally.case():
            found, gradient = expected, expected_gradient
            if backend != "reference64":
                found, gradient = BACKENDS[backend](cloud, planes, weight)
            if len(found):
                # Gaussians that nearly miss the planes are cut off at 6 sigma: 1.5e-8 of each amplitude
                bound = shape_tolerance(ratio) * max(largest, 1e-6 * height) + 2e-8 * height
                assert float((found - expected).abs().max()) <= bound, backend
            for what, g in gradient.items():
                assert torch.isfinite(g).all(), (backend, what)
                exact = expected_gradient[what]
                if backend in FAST and exact.numel() and largest > 1e-3 * height > 0:
                    error = float((g - exact).norm()) / max(float(exact.norm()), 1e-300)
                    assert error <= gradient_tolerance(ratio), (backend, what)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-4, 1.0, np.pi - 1e-9, np.pi])
def test_turns_of_the_twist_of_any_size(angle: float, tally: Tally) -> None:
    scene = head_scene()
    axis = np.random.default_rng(1).normal(size=(len(scene.planes), 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    twist = torch.tensor(np.concatenate([angle * axis, np.zeros_like(axis)], 1))
    weight = torch.tensor(np.random.default_rng(0).normal(size=scene.planes.n_pixels))
    grads = {}
    for backend, cloud in (("reference", scene.cloud), ("numba", single(scene.cloud))):
        with tally.case():
            leaf = twist.to(cloud.amplitude.dtype).clone().requires_grad_()
            options: dict[str, Any] = {"cutoff_sigma": 6.0} if backend == "numba" else {}
            pixels = render(cloud, scene.planes, twist=leaf, backend=backend, **options)
            (pixels * weight.to(pixels.dtype)).sum().backward()
            assert torch.isfinite(gradient_of(leaf)).all()
            grads[backend] = gradient_of(leaf).double()
    # float32 cannot represent pi, so the pose itself is off by 1e-7 rad, over 20 mm
    assert (grads["numba"] - grads["reference"]).norm() < 1e-4 * grads["reference"].norm()


@pytest.mark.numerics
def test_a_million_gaussians(tally: Tally) -> None:
    """The reference is the sum of images and gradients of the same Gaussians in a hundred parts."""
    n = 1_000_000
    rng = np.random.default_rng(6)
    cloud = cloud_of(
        rng.uniform(-60, 60, (n, 3)), rng.uniform(0.2, 0.6, (n, 3)), rng.normal(size=(n, 4)), rng.uniform(0, 1, n)
    )
    planes = stacks_of_planes(ORIGIN_MM, n_slices=1)
    weight = torch.ones(planes.n_pixels).double()
    near = torch.tensor(find_overlaps(single(cloud), planes, 6.0).gaussian.astype(np.int64)).unique()
    assert 1000 < len(near) < n // 10
    with tally.case():
        found, gradient = BACKENDS["numba"](cloud, planes, weight)
        part, part_gradient = BACKENDS["numba"](cloud.take(near), planes, weight)
        assert torch.equal(found, part)
        for name, g in gradient.items():
            assert torch.isfinite(g).all()
            of_near = g if name in ("turn", "shift", "gain") else g[near]
            assert torch.equal(of_near, part_gradient[name]), name
    with tally.case():
        few = replace(planes, shape=np.full_like(planes.shape, 2))
        exact = render(cloud.take(near), few, backend="reference")
        rough = render(single(cloud), few, cutoff_sigma=6.0).double()
        assert (exact - rough).abs().max() < 1e-5 * exact.abs().max()
    with tally.case():
        _, gradient = BACKENDS["objective"](cloud, planes, weight)
        assert all(torch.isfinite(g).all() for g in gradient.values())


@pytest.mark.parametrize("sigma_mm", [1e-3, 0.05, 1.0, 50.0])
def test_as_the_psf_goes_to_zero_slices_become_the_volume(sigma_mm: float, tally: Tally) -> None:
    """y - V(x) = (D : Hessian of V) / 2 + ..., so the difference falls with the square of the PSF's width."""
    scene = of_sigma(sigma_mm, 0.0)
    exact = volume_at(scene.cloud, scene.planes.pixel_world_mm())
    top = np.abs(exact).max()
    previous = np.inf
    for width in (0.3, 0.1, 0.03, 0.01, 1e-3, 1e-5, 0.0):
        planes = replace(scene.planes, psf_var_mm2=np.full((3, 3), (width * sigma_mm) ** 2))
        with tally.case():
            error = np.abs(render(scene.cloud, planes, backend="reference").numpy() - exact).max() / top
            # the Hessian is at most 1 / (0.7 sigma)^2 along each axis; positions are exact to 1e-14 mm
            assert error <= 3 * width**2 + 1e-13 / sigma_mm + 1e-13
            assert error <= previous + 1e-13 / sigma_mm
            previous = error
            rough = render(single(scene.cloud), planes, cutoff_sigma=6.0).numpy()
            assert np.abs(rough - exact).max() / top <= 3 * width**2 + 3e-6


def test_pairs_of_flat_gaussians_are_not_missed() -> None:
    """In float32 the variance across a disc is lost against that along it, which the search must allow for."""
    scene = flat(False, 40, 1e-5, 0.03)
    overlaps = find_overlaps(single(scene.cloud), scene.planes, 3.2)
    for k in range(len(scene.planes)):
        shown = render(scene.cloud.take(torch.tensor([k])), scene.planes.take([k]), backend="reference")
        assert shown.max() > 0.3 * scene.cloud.amplitude[k]
        assert k in overlaps.gaussian[overlaps.start[k] : overlaps.start[k + 1]]


def test_a_cloud_whose_origin_is_far_from_it_loses_no_pair() -> None:
    """The centres are in float64, 10 m from the cloud's local origin."""
    scene = head_scene()
    far = GaussianCloud.of([scene.cloud.mean_mm + 1e4, *scene.cloud.parameters[1:]], scene.cloud.origin_mm - 1e4)
    near, away = (find_overlaps(c, scene.planes, 3.2) for c in (scene.cloud, far))
    assert abs(len(near) - len(away)) <= 1e-3 * len(near)
    found = render(far, scene.planes, cutoff_sigma=6.0)
    exact = render(scene.cloud, scene.planes, backend="reference")
    assert (found - exact).abs().max() < 3e-6 * exact.max()


BAD_CLOUDS = {
    "NaN centre": (0, np.nan),
    "infinite centre": (0, np.inf),
    "NaN sigma": (1, np.nan),
    "sigma of 1e-9 mm": (1, np.log(1e-9)),
    "sigma of 1e9 mm": (1, np.log(1e9)),
    "NaN quaternion": (2, np.nan),
    "zero quaternion": (2, 0.0),
    "NaN amplitude": (3, np.nan),
    "infinite amplitude": (3, -np.inf),
}


@pytest.mark.parametrize("name", BAD_CLOUDS)
def test_clouds_that_are_not_numbers_are_refused(name: str, tally: Tally) -> None:
    which, value = BAD_CLOUDS[name]
    parameters = [p.clone() for p in head_scene().cloud.parameters]
    parameters[which][3] = value
    with tally.refusal():
        GaussianCloud.of(parameters, ORIGIN_MM)


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_calls_that_make_no_sense_are_refused(backend: str, tally: Tally) -> None:
    scene = head_scene()
    cloud, n = single(scene.cloud), len(scene.planes)
    twist, log_gain = torch.full((n, 6), torch.nan), torch.full((n,), torch.inf)
    bad: list[dict[str, Any]] = [{"twist": twist}, {"log_gain": log_gain}, {"attenuation": "other"}]
    for options in bad:
        with tally.refusal():
            render(cloud, scene.planes, backend=backend, **options)
    for dtype in (torch.float16, torch.bfloat16):
        half = [p.to(dtype) for p in cloud.parameters]
        with tally.refusal():
            render(GaussianCloud.of(half, cloud.origin_mm), scene.planes, backend=backend)


def test_a_sigma_of_more_pixels_than_integers_hold_is_refused(tally: Tally) -> None:
    scene = head_scene()
    mean, log_scale, *rest = scene.cloud.parameters
    cloud = GaussianCloud.of([mean, torch.full_like(log_scale, np.log(0.99 * SIGMA_RANGE_MM[1])), *rest], ORIGIN_MM)
    with tally.case():
        pixels = render(single(cloud), scene.planes, cutoff_sigma=6.0)
        assert (pixels - cloud.amplitude.sum()).abs().max() < 1e-4 * cloud.amplitude.sum()
    fine = replace(scene.planes, spacing_mm=scene.planes.spacing_mm * 1e-3)
    with pytest.raises(ValueError, match="pixels wide"):
        render(single(cloud), fine)
