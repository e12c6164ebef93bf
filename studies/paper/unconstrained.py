"""Baseline: Gaussians fitted to the slices alone, as in GSVR, without prior volume and without stage 1.

Isotropic Gaussians are seeded at random, or where V_coarse changes most, with the intensity of V_coarse. Then Adam fits
Gaussians, poses and gains with the L1 loss over the masked pixels. The renderer and the slice profile are those of the
product; the attenuation is as printed in Eq. 5 or exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_gradient_magnitude

from g3r.fitting.initial_volumes import InitialVolumes
from g3r.fitting.parameters import LearningRates
from g3r.fitting.schedules import cosine_decay
from g3r.fitting.slice_targets import SliceModel
from g3r.gaussians import GaussianCloud
from g3r.gaussians.overlap import OverlapList, find_overlaps
from g3r.gaussians.render import CUTOFF_SIGMA, moved_planes, render
from g3r.gaussians.seeding import SCALE_PER_SPACING

OVERLAP_MARGIN_SIGMA = 1.0
"""Margin of the overlap lists, which keeps them valid for several steps."""


@dataclass(frozen=True, kw_only=True)
class Unconstrained:
    """Settings of the unconstrained fit.

    Args:
        attenuation: "printed" for Eq. 5 as printed, or "exact".
        seeding: "random" in the foreground, or "gradient": denser where V_coarse changes.
        n_steps: of Adam.
        steps_per_list: steps between two updates of the overlap list.
    """

    attenuation: str = "exact"
    seeding: str = "random"
    n_steps: int = 200
    steps_per_list: int = 10


def fit_unconstrained(
    volumes: InitialVolumes,
    gain: NDArray[np.float64],
    weight: NDArray[np.float64],
    spacing_mm: float,
    settings: Unconstrained,
    rng: np.random.Generator,
    widths: Sequence[float] | None = None,
) -> GaussianCloud:
    """The Gaussians that fit the slices best.

    Args:
        volumes: initial volumes of the posed slices.
        gain: [K] initial intensity factors.
        weight: [K] slice weights.
        spacing_mm: cube root of the volume per Gaussian, as in the product's fit.
        settings: seeds, amplitudes, steps.
        rng: draws the seeds.
        widths: of each stack's profile through the plane, see `SliceModel.applied`.
    """
    slices = SliceModel().applied(volumes.slices, widths)
    planes = slices.planes
    cloud = seeds(volumes, spacing_mm, settings.seeding, rng)
    target = torch.from_numpy(slices.value)
    pixel_weight = torch.from_numpy(slices.mask * weight[planes.plane_id()].astype(np.float32))
    pixel_weight = pixel_weight / pixel_weight.sum()
    parameters = [p.clone().requires_grad_() for p in cloud.parameters]
    twist = torch.zeros(len(planes), 6, requires_grad=True)
    log_gain = torch.from_numpy(np.log(gain).astype(np.float32)).requires_grad_()
    rates = LearningRates()
    sigma, height = float(cloud.log_scale.mean().exp()), float(cloud.amplitude.abs().mean())
    steps = (rates.mean_share * sigma, rates.log_scale, rates.quaternion, rates.amplitude_share * height)
    groups = [{"params": [p], "lr": lr} for p, lr in zip(parameters, steps, strict=True)]
    groups += [{"params": [log_gain], "lr": rates.log_gain}, {"params": [twist], "lr": rates.rotation_rad}]
    adam = torch.optim.Adam(groups, betas=(0.9, 0.99))
    first = [group["lr"] for group in adam.param_groups]
    # a twist has rotations in rad and translations in mm, which need longer steps
    unit = torch.tensor([1.0] * 3 + [rates.translation_mm / rates.rotation_rad] * 3)
    overlaps: OverlapList | None = None
    for step in range(settings.n_steps):
        now = GaussianCloud.of(parameters, cloud.origin_mm)
        if step % settings.steps_per_list == 0:
            moved = moved_planes(planes, twist.detach() * unit)
            overlaps = find_overlaps(now.detach(), moved, CUTOFF_SIGMA + OVERLAP_MARGIN_SIGMA)
        pixels = render(
            now, planes, twist=twist * unit, log_gain=log_gain, attenuation=settings.attenuation, overlaps=overlaps
        )
        loss = (pixel_weight * (pixels - target).abs()).sum()
        adam.zero_grad()
        loss.backward()
        for group, rate in zip(adam.param_groups, first, strict=True):
            group["lr"] = rate * cosine_decay(step / settings.n_steps)
        adam.step()
    return GaussianCloud.of(parameters, cloud.origin_mm).detach()


def seeds(volumes: InitialVolumes, spacing_mm: float, seeding: str, rng: np.random.Generator) -> GaussianCloud:
    """Isotropic Gaussians at random voxels of the foreground, with the intensity of V_coarse there.

    Args:
        volumes: initial volumes of the slices.
        spacing_mm: cube root of the volume per Gaussian.
        seeding: see `Unconstrained`.
        rng: draws the voxels.
    """
    grid, support = volumes.grid, volumes.foreground.support()
    inside = np.argwhere(support)
    n = max(1, round(len(inside) * grid.voxel_volume_mm3 / spacing_mm**3))
    chance = np.ones(len(inside))
    if seeding == "gradient":
        change = gaussian_gradient_magnitude(volumes.coarse, 1.0)[support]
        chance = change + 0.1 * change.mean()
    chosen = inside[rng.choice(len(inside), n, replace=n > len(inside), p=chance / chance.sum())]
    points = grid.world(chosen + rng.uniform(-0.5, 0.5, chosen.shape)) - grid.center_mm
    sigma_mm = SCALE_PER_SPACING * spacing_mm
    height = volumes.coarse[tuple(chosen.T)] * spacing_mm**3 / ((2 * np.pi) ** 1.5 * sigma_mm**3)
    turn = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    arrays = (points, np.full((n, 3), np.log(sigma_mm)), turn, height)
    return GaussianCloud.of([torch.from_numpy(a.astype(np.float32)) for a in arrays], grid.center_mm)
