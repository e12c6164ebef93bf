"""What held-out slices say of the model: how wide the slice profile is, and how far V_prior improves the volume.

Every few slices are held out of a short fit in a slab of the head, and predicted by it. The residual of slices that
are fitted always prefers a narrower profile and less prior; that of slices that are not has a minimum.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.fitting.initial_volumes import PriorVolume
from g3r.fitting.prior_stage import NO_PROGRESS, VolumeTarget
from g3r.fitting.prior_targets import distillation_target
from g3r.fitting.slice_stage import SliceStageSettings, fit_slices
from g3r.fitting.slice_targets import SliceModel, SliceTarget, slice_target
from g3r.gaussians import GaussianCloud, render

EVERY = 5
"""One slice in so many is held out, from another start in each stack."""

WIDTHS = (0.85, 1.0)
"""Widths that are tried first; then one beyond the better."""

STEP = 1.18
"""Ratio of neighbouring widths."""

WIDTH_RANGE = (0.6, 1.35)

WIDTH_TRUST = 0.5
"""How far the width goes from the nominal one to the best on held-out slices (on the logarithm): the rim of the brain
wants a wider profile than its inside, and counts for most of the error (docs/method.md)."""

MIN_CONTRAST = 0.003
"""Smallest rise of the error within the widths tried by which a width counts as found."""

MIN_PIXELS, MIN_HELD_OUT = 100, 3
"""Held-out slices with fewer pixels in the slab do not count; fewer slices say nothing."""

SLAB_MARGIN_MM = 7.0
"""Gaussians so far outside the slab still reach its pixels."""


@dataclass(frozen=True, kw_only=True)
class HeldOutSettings:
    """How long held-out slices are asked.

    Args:
        slab: share of the head's voxels in the slab.
        n_steps: of each short fit.
    """

    slab: float = 0.4
    n_steps: int = 25


@dataclass(frozen=True, kw_only=True)
class HeldOutChoice:
    """What the held-out slices chose.

    Attributes:
        width: of the slice profile over the nominal one; None where the error has no clear minimum.
        prior_weight: of V_prior in the mixture of volumes that predicts them best, from 0 to 1; None where too few
            slices were held out. V_prior was made of all slices, and the short fit has fewer of them than the whole
            one: both flatter it, see `prior_weight`.
        error: mean absolute error of held-out pixels by width, in normalised intensities.
        prior_error: that of V_prior.
        n_slices: that were held out and counted.
    """

    width: float | None = None
    prior_weight: float | None = None
    error: dict[str, float]
    prior_error: float | None = None
    n_slices: int = 0


@dataclass(frozen=True)
class Prediction:
    """Held-out pixels [P'], their values by the fit and by V_prior, and the share of brain in them."""

    measured: NDArray[np.float32]
    fitted: NDArray[np.float32]
    prior: NDArray[np.float32]
    slice_number: NDArray[np.int64]
    share: NDArray[np.float32]

    def error(self, prior_weight: float = 0.0) -> float:
        """Mean absolute error of a mixture of both, with one gain a slice."""
        mixed = (1 - prior_weight) * self.fitted + prior_weight * self.prior
        across = np.bincount(self.slice_number, self.share * mixed * self.measured)
        own = np.bincount(self.slice_number, self.share * mixed * mixed)
        gain = np.divide(across, own, out=np.ones_like(own), where=own > 0)
        # in the units of what was measured, whatever was taken out of the pixel
        return float((self.share * np.abs(gain[self.slice_number] * mixed - self.measured)).mean())


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
    progress: Callable[[int, int], None] = NO_PROGRESS,
) -> HeldOutChoice:
    """Width of the slice profile and weight of the prior with which held-out slices are predicted best.

    Args:
        cloud: of stage 1, fitted to V_prior.
        prior: with the posed slices.
        weight: [K] slice weights.
        distillation: whether the fits are held to V_prior.
        model: of the slices; its widths are replaced by those that are tried.
        stage: of the fit to the slices, of which these are short ones.
        settings: how long.
        rng: draws what the fits draw.
        progress: called with (fits done, fits in all).
    """
    slices = prior.volumes.slices
    held = held_out_rows(slices, weight)
    single = slices.n_stacks == 1
    axis, low, high = _slab(prior, settings.slab)
    target = _target(prior, axis, low, high) if distillation else None
    mean_mm = cloud.mean_mm.numpy()[:, axis] + cloud.origin_mm[axis]
    part = cloud.take(torch.from_numpy((mean_mm > low - SLAB_MARGIN_MM) & (mean_mm < high + SLAB_MARGIN_MM)))
    place = slices.planes.pixel_world_mm()[:, axis]
    in_slab = (place > low) & (place < high)
    short = replace(stage, n_steps=settings.n_steps, optimise_poses=False)

    def predict(width: float) -> Prediction | None:
        whole = slice_target(prior, weight, model.of_width(width))
        seen = replace(whole.slices, mask=slices.mask & in_slab)
        sliced = SliceTarget(seen, whole.pixel_weight * in_slab)
        return _predict(part, sliced, prior.gain, weight, held, target, short, rng)

    found: dict[float, Prediction] = {}
    progress(0, 3)
    for width in WIDTHS:
        predicted = predict(width)
        if predicted is None:
            return HeldOutChoice(error={})
        found[width] = predicted
        progress(len(found), 3)
    narrower = found[WIDTHS[0]].error() < found[WIDTHS[1]].error()
    third = WIDTHS[0] / STEP if narrower else WIDTHS[1] * STEP
    last = predict(third)
    assert last is not None  # the same pixels
    found[third] = last
    progress(3, 3)
    error = {width: found[width].error() for width in sorted(found)}
    best = found[min(error, key=lambda width: error[width])]
    return HeldOutChoice(
        # between slices of a single stack a narrow profile and a smooth volume look alike
        width=None if single else _minimum(error),
        prior_weight=_best_weight(best),
        error={f"{width:.3g}": value for width, value in error.items()},
        prior_error=best.error(1.0),
        n_slices=int(best.slice_number.max()) + 1,
    )


def held_out_rows(slices: Slices, weight: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of K slices are held out: one in `EVERY` of each stack, trusted ones alone."""
    held = np.zeros(len(slices), bool)
    for number, stack in enumerate(np.unique(slices.stack_id)):
        rows = np.flatnonzero(slices.stack_id == stack)
        held[rows[(2 + number) % EVERY :: EVERY]] = True
    return held & (weight > 0.5 * np.median(weight))


def _slab(prior: PriorVolume, share: float) -> tuple[int, float, float]:
    """Axis and bounds (mm) of a slab through the middle of the head, across its longest axis."""
    grid = prior.volumes.grid
    world = grid.world(np.argwhere(prior.mask))
    axis = int(np.argmax(np.ptp(world, axis=0)))
    low, high = np.quantile(world[:, axis], [0.5 - share / 2, 0.5 + share / 2])
    return axis, float(low), float(high)


def _target(prior: PriorVolume, axis: int, low: float, high: float) -> VolumeTarget:
    """The distillation target in the slab."""
    grid = prior.volumes.grid
    world = grid.world(np.moveaxis(np.indices(grid.shape), 0, -1))[..., axis]
    return distillation_target(replace(prior, support=prior.support & (world > low) & (world < high)))


def _predict(
    cloud: GaussianCloud,
    sliced: SliceTarget,
    gain: NDArray[np.float64],
    weight: NDArray[np.float64],
    held: NDArray[np.bool_],
    target: VolumeTarget | None,
    stage: SliceStageSettings,
    rng: np.random.Generator,
) -> Prediction | None:
    """A short fit without the held-out slices and what it makes of them; None where they are too few."""
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
        rng=rng,
        pixel_weight=sliced.pixel_weight * ~held[plane],
    )
    asked = slices.take(rows)
    index = asked.pixel_index
    held_pixels = np.flatnonzero(slices.mask & np.isin(plane, rows))
    return Prediction(
        measured=asked.value[index],
        fitted=render(fit.cloud, asked.planes).numpy()[index],
        prior=render(cloud, asked.planes).numpy()[index],
        slice_number=asked.planes.plane_id()[index],
        share=sliced.pixel_weight[held_pixels],
    )


def _best_weight(predicted: Prediction) -> float:
    """Weight of V_prior from 0 to 1 that predicts best."""
    weights = np.linspace(0, 1, 21)
    return float(weights[np.argmin([predicted.error(float(value)) for value in weights])])


def _minimum(error: dict[float, float]) -> float | None:
    """Width to take by the lowest point of a parabola through three errors over the logarithm of the width."""
    widths, values = np.array(list(error)), np.array(list(error.values()))
    if not values.max() > (1 + MIN_CONTRAST) * values.min():
        return None
    curvature, slope, _ = np.polyfit(np.log(widths), values, 2)
    at = math.exp(-slope / (2 * curvature)) if curvature > 0 else float(widths[np.argmin(values)])
    at = min(max(at, float(widths.min()) / math.sqrt(STEP)), float(widths.max()) * math.sqrt(STEP))
    return min(max(at, WIDTH_RANGE[0]), WIDTH_RANGE[1]) ** WIDTH_TRUST
