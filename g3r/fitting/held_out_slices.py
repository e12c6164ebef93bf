"""Widths of the slice profiles, estimated from held-out slices.

Every few slices are held out of a short fit in a slab of the head, and predicted by it. The residual of slices that
are fitted always prefers a narrower profile; that of held-out slices has a minimum.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.fitting.bias_field import StackBiasField
from g3r.fitting.fit_context import FitContext
from g3r.fitting.held_out_prediction import MIN_HELD_OUT, HeldOutFit, lowest
from g3r.fitting.initial_volumes import PriorVolume
from g3r.fitting.prior_stage import VolumeTarget
from g3r.fitting.prior_targets import distillation_target
from g3r.fitting.slice_stage import SliceStageSettings, fit_slices
from g3r.fitting.slice_targets import SliceModel, SliceTarget, slice_target
from g3r.gaussians import GaussianCloud
from g3r.run.on_demand import torch
from g3r.run.progress import Progress, no_progress

EVERY = 5
"""One slice in this many is held out, beginning with another slice in each stack."""

WIDTHS = (0.85, 1.0)
"""Widths that are tried first; the third is beyond the better one."""

STEP = 1.18
"""Ratio of neighbouring widths."""

WIDTH_RANGE = (0.6, 1.35)

WIDTH_TRUST = 0.5
"""Exponent of the best width on held-out slices in the mean width: 0 is the nominal width, 1 the best one. The rim of
the brain prefers a wider profile than its inside, and makes most of the error (docs/method.md)."""

MIN_PIXELS = 100
"""Held-out slices with fewer pixels in the slab are not used."""

SLAB_MARGIN_MM = 7.0
"""Distance from the slab up to which Gaussians outside still reach its pixels."""


@dataclass(frozen=True, kw_only=True)
class HeldOutSettings:
    """Size of the slab, and length of the fits without held-out slices.

    Args:
        slab: share of the head's voxels in the slab.
        n_steps: of each short fit.
    """

    slab: float = 0.25
    n_steps: int = 15


@dataclass(frozen=True, kw_only=True)
class HeldOutChoice:
    """Widths of the slice profiles that held-out slices chose.

    Attributes:
        mean_width: of all slice profiles, through the plane, over the nominal one; None where the error has no clear
            minimum.
        widths: of each stack, to be used: the mean half way to the nominal one, times the stack's over the mean.
        error: mean absolute error of held-out pixels by the width of all stacks, in normalised intensities.
        n_slices: number of held-out slices that counted.
    """

    mean_width: float | None = None
    widths: list[float] | None = None
    error: dict[str, float]
    n_slices: int = 0


def ask_held_out_slices(
    cloud: GaussianCloud,
    prior: PriorVolume,
    weight: NDArray[np.float64],
    *,
    distillation: bool,
    model: SliceModel,
    stage: SliceStageSettings,
    settings: HeldOutSettings,
    rng: np.random.Generator,
    progress: Progress = no_progress,
) -> HeldOutChoice:
    """Widths of the slice profiles with which held-out slices are predicted best.

    For several stacks only: in a single stack a narrow profile and a smooth volume look alike.

    Args:
        cloud: of stage 1, fitted to V_prior.
        prior: with the posed slices.
        weight: [K] slice weights.
        distillation: whether the fits are held to V_prior.
        model: of the slices; its width through the plane is replaced by those that are tried.
        stage: of the fit to the slices; the fits here take fewer steps.
        settings: slab and number of steps.
        rng: draws what the fits draw.
        progress: called with (fits done, fits in all).
    """
    slices = prior.volumes.slices
    held = held_out_rows(slices, weight)
    slab = _Slab.in_middle(prior, settings.slab)
    target = _target(prior, slab) if distillation else None
    mean_mm = cloud.mean_mm.numpy() + cloud.origin_mm
    part = cloud.take(torch.from_numpy(slab.holds(mean_mm, SLAB_MARGIN_MM)))
    in_slab = slab.holds(slices.planes.pixel_world_mm())
    # in so few steps, each step has to see every slice
    short = replace(stage, n_steps=settings.n_steps, n_parts=1, optimise_poses=False)

    def fitted(width: float) -> HeldOutFit | None:
        whole = slice_target(prior, weight, model, [width] * slices.n_stacks)
        seen = replace(whole.slices, mask=slices.mask & in_slab)
        sliced = SliceTarget(seen, whole.pixel_weight * in_slab)
        return _short_fit(part, sliced, prior.gain, weight, held, target, short, rng)

    tried = _try_widths(fitted, progress)
    if not tried:
        return HeldOutChoice(error={})
    error = {width: tried[width][1] for width in sorted(tried)}
    best = tried[min(error, key=lambda width: error[width])][0]
    mean_width = lowest(list(error), list(error.values()))
    return HeldOutChoice(
        mean_width=mean_width,
        widths=None if mean_width is None else _widths(mean_width, best.relative_widths(np.unique(slices.stack_id))),
        error={f"{width:.3g}": value for width, value in error.items()},
        n_slices=len(best.slices),
    )


def _try_widths(
    fitted: Callable[[float], HeldOutFit | None], progress: Progress
) -> dict[float, tuple[HeldOutFit, float]]:
    """Fits and their errors by width: two, and one beyond the better; none if too few slices are held out."""
    tried: dict[float, tuple[HeldOutFit, float]] = {}
    widths = list(WIDTHS)
    for number in range(3):
        progress(number, 3)
        fit = fitted(widths[number])
        if fit is None:
            return {}
        tried[widths[number]] = fit, float(fit.errors().mean())
        if number == 1:
            narrower = tried[WIDTHS[0]][1] < tried[WIDTHS[1]][1]
            widths.append(WIDTHS[0] / STEP if narrower else WIDTHS[1] * STEP)
    progress(3, 3)
    return tried


def _widths(mean_width: float, relative: NDArray[np.float64]) -> list[float]:
    """Widths to be used for each stack.

    Args:
        mean_width: best for all stacks alike.
        relative: [N] width of each over the mean.
    """
    return [round(float(width), 3) for width in np.clip(mean_width**WIDTH_TRUST * relative, *WIDTH_RANGE)]


def held_out_rows(slices: Slices, weight: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of K slices are held out: one in `EVERY` of each stack, without slices of low weight."""
    held = np.zeros(len(slices), bool)
    for number, stack in enumerate(np.unique(slices.stack_id)):
        rows = np.flatnonzero(slices.stack_id == stack)
        held[rows[(2 + number) % EVERY :: EVERY]] = True
    return held & (weight > 0.5 * np.median(weight))


@dataclass(frozen=True)
class _Slab:
    """The space between two planes that are oblique to the usual stacks, so that it cuts slices of each of them."""

    low_mm: float
    high_mm: float

    NORMAL: ClassVar = np.full(3, 1 / math.sqrt(3))

    @classmethod
    def in_middle(cls, prior: PriorVolume, share: float) -> _Slab:
        """Through the middle of the head, with a share of its voxels."""
        place_mm = prior.volumes.grid.world(np.argwhere(prior.mask)) @ cls.NORMAL
        low_mm, high_mm = np.quantile(place_mm, [0.5 - share / 2, 0.5 + share / 2])
        return cls(float(low_mm), float(high_mm))

    def holds(self, points_mm: NDArray[np.float64], margin_mm: float = 0.0) -> NDArray[np.bool_]:
        """Which of the points [..., 3] are in it, or at most `margin_mm` outside."""
        place_mm = points_mm @ self.NORMAL
        return (place_mm > self.low_mm - margin_mm) & (place_mm < self.high_mm + margin_mm)


def _target(prior: PriorVolume, slab: _Slab) -> VolumeTarget:
    """The distillation target in the slab."""
    grid = prior.volumes.grid
    world_mm = grid.world(np.moveaxis(np.indices(grid.shape), 0, -1))
    return distillation_target(replace(prior, support=prior.support & slab.holds(world_mm)))


def _short_fit(
    cloud: GaussianCloud,
    sliced: SliceTarget,
    gain: NDArray[np.float64],
    weight: NDArray[np.float64],
    held: NDArray[np.bool_],
    target: VolumeTarget | None,
    stage: SliceStageSettings,
    rng: np.random.Generator,
) -> HeldOutFit | None:
    """A short fit without the held-out slices; None where they are too few."""
    slices = sliced.slices
    plane = slices.planes.plane_id()
    counts = np.bincount(plane[slices.mask], minlength=len(slices))
    rows = np.flatnonzero(held & (counts >= MIN_PIXELS))
    if len(rows) < MIN_HELD_OUT or (held | (counts < MIN_PIXELS)).all():
        return None
    fit = fit_slices(
        cloud,
        slices,
        gain=gain,
        weight=weight,
        prior=target,
        settings=stage,
        context=FitContext(rng=rng),
        pixel_weight=sliced.pixel_weight * ~held[plane],
    )
    held_pixels = np.flatnonzero(slices.mask & np.isin(plane, rows))
    field = np.ones(len(held_pixels), np.float32)
    if fit.bias_field:
        field = np.exp(StackBiasField(slices).log_field(np.array(fit.bias_field))[held_pixels])
    return HeldOutFit(fit.cloud, slices.take(rows), sliced.pixel_weight[held_pixels], field)
