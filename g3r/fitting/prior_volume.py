"""V_prior and the brain mask of a subject, from its volumes, the prior network and the atlas template."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.coverage import UNSEEN_BELOW
from g3r.acquisition.smooth_fill import smooth_fill
from g3r.fitting.initial_volumes import InitialVolumes, PriorVolume
from g3r.fitting.least_squares_volume import least_squares_volume
from g3r.prior.maps import PriorMaps, Tiling
from g3r.prior.subject_template import PlacedTemplate
from g3r.registration.atlas_frame import Orientation

if TYPE_CHECKING:
    from g3r.prior.model import Prior

KNOWN_DENSITY = 2 * UNSEEN_BELOW
"""Density from which on the slices' volume is taken unchanged, if no template fills what is missing."""


def placed_template(prior: Prior | None, orientation: Orientation | None) -> PlacedTemplate | None:
    """The prior's template in the frame of the slices; None without a prior, or if the slices have another frame."""
    if prior is None or orientation is None or not prior.network.config.use_template:
        return None
    return PlacedTemplate.of(prior.template, orientation.weeks, orientation.scale)


def prior_volume(
    volumes: InitialVolumes,
    gain: NDArray[np.float64],
    weight: NDArray[np.float64],
    prior: Prior | None,
    placed: PlacedTemplate | None,
    *,
    n_views: int,
    tiling: Tiling,
    least_squares: bool = False,
) -> PriorVolume:
    """V_prior (G3R Eq. 7) and the brain mask; shape decides on the unseen part of the head.

    Args:
        volumes: volumes of the slices alone.
        gain: [K] of the slices.
        weight: [K] of the slices.
        prior: None takes V_sharp, smoothly continued into what was not seen.
        placed: its atlas template; if None, a smooth continuation takes its place.
        n_views: see `estimate_prior`.
        tiling: see `estimate_prior`.
        least_squares: takes the least-squares volume in place of V_sharp if there is no prior: no fit will follow.
    """
    share, seen = volumes.share, volumes.foreground
    if placed is not None:
        fitted = placed.fitted(volumes.sharp, share, volumes.density, volumes.grid)
        guess, outline = fitted.values, fitted.inside
    else:
        mask, support = seen.mask(), seen.support()
        known = least_squares_volume(volumes, support, gain, weight) if least_squares else volumes.sharp
        guess = smooth_fill(known, np.clip(volumes.density / KNOWN_DENSITY, 0, 1), share)
        outline = mask.astype(np.float32)
    values, brain = guess, None
    if prior is not None:
        maps = PriorMaps(
            coarse=volumes.coarse,
            density=volumes.density,
            share=share,
            sharp=volumes.sharp,
            template=guess,
            outline=outline,
        )
        found = prior.estimate(maps, n_views=n_views, tiling=tiling)
        values, brain = found.volume, found.brain
    if prior is not None or placed is not None:
        mask, support = seen.mask(brain), seen.support(brain)
    return PriorVolume(
        volumes=volumes,
        values=values,
        brain=brain,
        mask=mask,
        support=support,
        has_template=placed is not None,
        gain=gain,
        scale=volumes.scale,
    )
