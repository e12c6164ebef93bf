"""The slices as target of the fit: with their profile, and with what lies beside the brain taken out of their rim."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.acquisition.surroundings import without_surroundings
from g3r.fitting.initial_volumes import PriorVolume


@dataclass(frozen=True, kw_only=True)
class SliceModel:
    """Forward model of a slice: width of its profile, and treatment of its rim.

    Args:
        through_plane, in_plane: width of the profile over the nominal one (`psf_variance_mm2`). Slices that share a
            blur in plane do not determine it (the volume takes it up), so that width is set, not measured.
        surroundings: whether what lies beside the brain is taken out of the pixels of the rim.
    """

    through_plane: float = 0.95
    in_plane: float = 0.75
    surroundings: bool = True

    def applied(self, slices: Slices, widths: Sequence[float] | None = None) -> Slices:
        """The slices with the profile of the model in place of the nominal one.

        Args:
            slices: K slices with the nominal profile.
            widths: of each stack's profile through the plane, if estimated, in place of the model's.
        """
        _, stack = np.unique(slices.stack_id, return_inverse=True)
        through = np.broadcast_to(self.through_plane if widths is None else np.asarray(widths), slices.n_stacks)[stack]
        in_plane = np.full(len(slices), self.in_plane)
        variance = slices.planes.psf_var_mm2 * np.stack([in_plane, in_plane, through], axis=1) ** 2
        return replace(slices, planes=replace(slices.planes, psf_var_mm2=variance))


@dataclass(frozen=True)
class SliceTarget:
    """Target of the fit: the slices, and the weight [P] of each pixel."""

    slices: Slices
    pixel_weight: NDArray[np.float32]


def slice_target(
    prior: PriorVolume, weight: NDArray[np.float64], model: SliceModel, widths: Sequence[float] | None = None
) -> SliceTarget:
    """The posed slices under a slice model.

    Args:
        prior: with the slices and the support of the volume.
        weight: [K] slice weights.
        model: of the slices.
        widths: of each stack's profile through the plane, if estimated, in place of the model's.
    """
    slices = model.applied(prior.volumes.slices, widths)
    if not model.surroundings:
        return SliceTarget(slices, slices.mask.astype(np.float32))
    slices, share = without_surroundings(slices, prior.support, prior.volumes.grid, prior.gain, weight)
    return SliceTarget(slices, slices.mask * share)
