"""Errors of the renderer and its gradients over orders of magnitude: the rows of docs/numerics.md."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from g3r.acquisition.planes import Planes, volume_planes
from g3r.acquisition.psf import psf_variance_mm2
from g3r.gaussians import GaussianCloud, render
from g3r.geometry import VolumeGrid
from tests.numerics.oracles import absolute, integrated_pixels, naive_render, volume_at
from tests.numerics.scenes import PIXEL_MM, Scene, cloud_of, head_scene, single, slender_scenes

EPS32 = float(np.finfo(np.float32).eps)

RATIOS = (1.0, 10.0, 100.0, 1000.0, 5000.0)
WIDEST_MM = 100.0
SIGMAS_MM = (0.02, 0.1, 1.0, 10.0, 100.0)
THICKNESSES_MM = (0.1, 2.2, 20.0)
SIGMAS_PER_PIXEL = (0.02, 0.1, 0.2, 0.3, 0.5, 0.8, 1.5)
DISTANCES_M = (0.0, 1.0, 10.0, 100.0)

FULL_CUTOFF = 6.0
"""Cut-off at which the errors below are purely arithmetic: it removes 1.5e-8 of an amplitude."""

Row = dict[str, float]


def shape_tolerance(ratio: float) -> float:
    """Tolerance of float32 pixels at an axis ratio: largest error relative to the largest pixel.

    It is 2e-6 for the polynomial exponential (2e-7), the rounded parameters and the sums, plus eps times the
    ratio: a position along the long axis is rounded to eps of its length, and for a slanted Gaussian this error
    has a component along the short axis, where it counts in units of the shortest sigma.
    """
    return 2e-6 + EPS32 * ratio


def gradient_tolerance(ratio: float) -> float:
    """Tolerance of float32 gradients at an axis ratio: largest relative error.

    It is 2e-4 because sums of random weights cancel: the gradient in shape is a difference of second and zeroth
    moments with errors of 2e-6, and is up to a hundred times smaller than the moments. To this is added 8 eps times the
    ratio, because the moments of a slanted Gaussian are taken along the plane's axes, as in `shape_tolerance`.
    """
    return 2e-4 + 8 * EPS32 * ratio


def shape_rows(ratios: tuple[float, ...] = RATIOS) -> list[Row]:
    """Error of values by axis ratio, for V(x) and for slices, for every method of computation."""
    return _largest_by_ratio(value_errors, ratios)


def gradient_rows(ratios: tuple[float, ...] = RATIOS) -> list[Row]:
    """Relative error of numba's gradients by axis ratio, against autograd of the reference in float64."""
    return _largest_by_ratio(gradient_errors, ratios)


def _largest_by_ratio(errors: Callable[[Scene], Row], ratios: tuple[float, ...]) -> list[Row]:
    rows = []
    for psf in (False, True):
        for ratio in ratios:
            row: Row = {"psf": psf, "ratio": ratio}
            for scene in slender_scenes(ratio, WIDEST_MM if ratio > 1000 else WIDEST_MM / 5, psf):
                for name, error in errors(scene).items():
                    row[name] = max(row.get(name, 0.0), error)
            rows.append(row)
    return rows


def value_errors(scene: Scene) -> Row:
    """Largest error of one scene over its largest pixel: float64 against integration, the others against float64.

    The error is inf if a value is not finite.
    """
    cloud, planes = scene.cloud, scene.planes
    exact = render(cloud, planes, backend="reference").numpy()
    if planes.psf_var_mm2.min() > 0:
        few = replace(planes, shape=np.full_like(planes.shape, 2))
        float64 = relative_error(render(cloud, few, backend="reference").numpy(), integrated_pixels(cloud, few))
    else:
        float64 = relative_error(exact, volume_at(cloud, planes.pixel_world_mm()))
    rough = single(cloud)
    found = {
        "reference float32": render(rough, planes, backend="reference"),
        "numba": render(rough, planes, cutoff_sigma=FULL_CUTOFF),
        "naive float32": naive_render(cloud, planes, torch.float32),
        "naive float32, epsilon": naive_render(cloud, planes, torch.float32, 1e-8),
        "naive float64": naive_render(cloud, planes, torch.float64),
    }
    return {"float64": float64} | {name: relative_error(y.numpy(), exact) for name, y in found.items()}


def relative_error(found: NDArray[np.floating], exact: NDArray[np.floating]) -> float:
    """Largest difference relative to the largest exact value; inf if a value is not finite."""
    found = found.astype(np.float64)
    if not np.isfinite(found).all():
        return math.inf
    top = float(np.abs(exact).max(initial=0.0))
    error = float(np.abs(found - exact).max(initial=0.0))
    return error / top if top > 0 else error


def gradients(
    cloud: GaussianCloud, planes: Planes, weight: Tensor, dtype: torch.dtype, **options: float | str
) -> tuple[Tensor, dict[str, Tensor]]:
    """Pixels, and the gradients of their weighted sum in all parameters, in float64.

    Log-scales and quaternions are one entry, `shape`, because the quaternion of a round Gaussian has gradient zero.
    """
    leaves = [p.detach().to(dtype).requires_grad_() for p in cloud.parameters]
    further = [torch.zeros(len(planes), n, dtype=dtype, requires_grad=True) for n in (6, 1)]
    pixels = render(
        GaussianCloud.of(leaves, cloud.origin_mm),
        planes,
        twist=further[0],
        log_gain=further[1][:, 0],
        **options,  # type: ignore[arg-type]
    )
    (pixels * weight.to(dtype)).sum().backward()
    nothing = [torch.zeros_like(leaf) for leaf in (*leaves, *further)]
    grads = [
        (zero if leaf.grad is None else leaf.grad).double()
        for leaf, zero in zip((*leaves, *further), nothing, strict=True)
    ]
    mean, log_scale, quaternion, amplitude, twist, gain = grads
    return pixels.detach().double(), {
        "centre": mean,
        "shape": torch.cat([log_scale, quaternion], 1),
        "amplitude": amplitude,
        "turn": twist[:, :3],
        "shift": twist[:, 3:],
        "gain": gain,
    }


def gradient_errors(scene: Scene, seed: int = 0) -> Row:
    """Norm of the error relative to the norm of each gradient for random weights; inf if a gradient is not finite."""
    weight = torch.tensor(np.random.default_rng(seed).normal(size=scene.planes.n_pixels))
    _, exact = gradients(scene.cloud, scene.planes, weight, torch.float64, backend="reference")
    _, found = gradients(scene.cloud, scene.planes, weight, torch.float32, cutoff_sigma=FULL_CUTOFF)
    errors = {}
    for name, gradient in exact.items():
        if not torch.isfinite(found[name]).all():
            errors[name] = math.inf
        else:
            norm = float(gradient.norm())
            errors[name] = float((found[name] - gradient).norm()) / norm if norm > 0 else 0.0
    return errors


def size_rows(
    sigmas_mm: tuple[float, ...] = SIGMAS_MM, thicknesses_mm: tuple[float, ...] = THICKNESSES_MM
) -> list[Row]:
    """Error of numba's values by size of nearly round Gaussians and slice thickness (0: V(x)).

    For comparison, V(x) with 1e-8 mm^6 added to determinants, to show that an absolute epsilon has a hidden unit.
    """
    rows = []
    for sigma in sigmas_mm:
        row: Row = {"sigma_mm": sigma}
        for thickness in (0.0, *thicknesses_mm):
            row[f"{thickness:g}"] = max(
                relative_error(
                    render(single(scene.cloud), scene.planes, cutoff_sigma=FULL_CUTOFF).numpy(),
                    render(scene.cloud, scene.planes, backend="reference").numpy(),
                )
                for scene in sized_scenes(sigma, thickness)
            )
        row["epsilon"] = max(
            relative_error(
                naive_render(scene.cloud, scene.planes, torch.float64, 1e-8).numpy(),
                volume_at(scene.cloud, scene.planes.pixel_world_mm()),
            )
            for scene in sized_scenes(sigma, 0.0)
        )
        rows.append(row)
    return rows


def sized_scenes(sigma_mm: float, thickness_mm: float, n: int = 6, seed: int = 1) -> list[Scene]:
    """Gaussians of similar size on planes of similar size; a thickness of zero means no PSF."""
    rng = np.random.default_rng(seed)
    scenes = []
    for _ in range(n):
        base = slender_scenes(1.0, sigma_mm, False, 1, int(rng.integers(1 << 30)))[0]
        cloud = cloud_of(
            base.cloud.mean_mm.numpy(),
            sigma_mm * rng.uniform(0.7, 1.0, (1, 3)),
            rng.normal(size=(1, 4)),
            np.ones(1),
            base.cloud.origin_mm,
        )
        planes = base.planes
        if thickness_mm:
            spacing = np.maximum(planes.spacing_mm, 0.1)
            variance = psf_variance_mm2(spacing, np.full(len(planes), thickness_mm))
            planes = replace(planes, spacing_mm=spacing, psf_var_mm2=variance)
        scenes.append(Scene(cloud, planes))
    return scenes


def comb(sigma: float, phase: float) -> float:
    """Sum over integers n of a unit Gaussian of a sigma at n - phase; 1 if samples give its integral exactly.

    By Poisson's formula it is 1 + 2 sum_m exp(-2 pi^2 sigma^2 m^2) cos(2 pi m phase). It is summed directly, which
    converges for any sigma.
    """
    n = np.arange(-math.ceil(8 * sigma) - 2, math.ceil(8 * sigma) + 3)
    return float(np.exp(-0.5 * ((n - phase) / sigma) ** 2).sum() / (sigma * math.sqrt(2 * math.pi)))


def pixel_rows(sigmas: tuple[float, ...] = SIGMAS_PER_PIXEL, n_places: int = 40) -> list[Row]:
    """Aliasing: ratio of a Gaussian's mass in samples to its true mass, by sigma in pixels.

    It is given for the voxels of a volume and for one gapless stack of slices with PSF (where the pixel is that of
    the slice; slices of 2.2 mm): minimum and maximum over random positions, and maximum and minimum by the formula.
    """
    rng = np.random.default_rng(2)
    rows = []
    for ratio in sigmas:
        sigma = ratio * PIXEL_MM
        row: Row = {"ratio": ratio}
        for name, step_mm, psf in (("volume", PIXEL_MM, False), ("slices", 2.2, True)):
            reach = math.ceil(6.5 * math.hypot(sigma, step_mm) / PIXEL_MM) + 2
            n_z = 2 * math.ceil(6.5 * math.hypot(sigma, step_mm if psf else 0) / step_mm) + 5
            affine = np.diag([PIXEL_MM, PIXEL_MM, step_mm, 1.0])
            grid = VolumeGrid((2 * reach + 1, 2 * reach + 1, n_z), affine)
            affine[:3, 3] = -grid.center_mm
            planes = volume_planes(VolumeGrid(grid.shape, affine))
            variance = psf_variance_mm2([PIXEL_MM, PIXEL_MM], step_mm) if psf else np.zeros(3)
            planes = replace(planes, psf_var_mm2=np.tile(variance, (len(planes), 1)))
            steps = np.array([PIXEL_MM, PIXEL_MM, step_mm])
            seen = []
            # the extreme positions are on a sample and midway between samples, along every axis
            places = np.concatenate([[[0.0, 0, 0], [0.5, 0.5, 0.5]], rng.uniform(-0.5, 0.5, (n_places, 3))])
            for place in places:
                cloud = cloud_of(
                    (place * steps)[None], np.full((1, 3), sigma), np.array([[1.0, 0, 0, 0]]), np.ones(1), np.zeros(3)
                )
                pixels = render(single(cloud), planes, cutoff_sigma=FULL_CUTOFF).double()
                mass = float(cloud.log_scale.sum().exp() * (2 * math.pi) ** 1.5)
                seen.append(float(pixels.sum()) * float(steps.prod()) / mass)
            total = np.sqrt(sigma**2 + variance) / steps
            row |= {
                f"{name} least": min(seen),
                f"{name} most": max(seen),
                f"{name} lower bound": math.prod(comb(s, 0.5) for s in total),
                f"{name} upper bound": math.prod(comb(s, 0.0) for s in total),
            }
        rows.append(row)
    return rows


def distance_rows(distances_m: tuple[float, ...] = DISTANCES_M) -> list[Row]:
    """Error of values by distance of the scene from the world's origin, with and without a local origin."""
    rows = []
    for distance in distances_m:
        origin = np.array([1.0, -1.0, 1.0]) * distance * 1000 / math.sqrt(3)
        scene = head_scene(origin)
        near = head_scene(np.zeros(3))
        exact = render(near.cloud, near.planes, backend="reference").numpy()
        here = naive_render(absolute(scene.cloud, torch.float32), scene.planes, torch.float32)
        rows.append(
            {
                "distance_m": distance,
                "reference float64": relative_error(
                    render(scene.cloud, scene.planes, backend="reference").numpy(), exact
                ),
                "reference float32": relative_error(
                    render(single(scene.cloud), scene.planes, backend="reference").numpy(), exact
                ),
                "numba": relative_error(
                    render(single(scene.cloud), scene.planes, cutoff_sigma=FULL_CUTOFF).numpy(), exact
                ),
                "naive float32": relative_error(here.numpy(), exact),
            }
        )
    return rows
