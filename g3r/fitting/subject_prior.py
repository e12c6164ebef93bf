"""V_prior of a subject from its posed slices: first the volumes of the slices alone, then the network's estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.acquisition.stacks import Stack
from g3r.fitting.initial_volumes import InitialVolumes, PriorVolume
from g3r.fitting.intensity_matching import match_intensities
from g3r.fitting.mask_agreement import RefinedMasks, refine_masks
from g3r.fitting.prior_volume import placed_template, prior_volume
from g3r.prior.maps import Tiling
from g3r.registration import Registration
from g3r.registration.prior_registration import register_to_prior
from g3r.run.allocator import release_memory

if TYPE_CHECKING:
    from g3r.prior.model import Prior

NOTE_ON_SINGLE = {  # by whether they moved to the prior; None where that was not tried
    None: "slices of the single stack stay where the atlas template or the header has them",
    True: "slices of the single stack were registered to the prior volume",
    False: "slices of the single stack stay where they were at first: the prior gave no reason to move",
}


@dataclass(frozen=True, kw_only=True)
class SubjectPrior:
    """Makes the volumes of a subject from its slices, again whenever they have moved.

    Args:
        network: None takes V_sharp, smoothly continued, for V_prior.
        voxel_mm: of the volumes.
        common_bias_field: whether the bias field that stacks share is divided out.
        least_squares: takes the least-squares volume for V_sharp where there is no network.
    """

    network: Prior | None
    voxel_mm: float
    common_bias_field: bool = True
    least_squares: bool = False

    def refined_masks(self, stacks: Sequence[Stack], poses: Registration, intensity: float) -> RefinedMasks:
        """Automatic masks, refined with the network's atlas template; see `refine_masks`.

        Args:
            stacks: as they were registered.
            poses: of their slices.
            intensity: that these slices were divided by.
        """
        return refine_masks(stacks, poses, intensity, placed_template(self.network, poses.orientation))

    def matched(self, poses: Registration) -> tuple[Registration, list[list[float]]]:
        """Poses with matched slices and gains, and the fields that were divided out; see `match_intensities`."""
        found = match_intensities(poses.slices, poses.gain, poses.weight)
        return replace(poses, slices=found.slices, gain=found.gain), found.coefficients

    def volumes(self, poses: Registration) -> InitialVolumes:
        """V_coarse and M_rho (Eq. 6), V_sharp and the foreground."""
        return self._volumes(poses.slices, poses.gain, poses, self.common_bias_field)

    def of(self, volumes: InitialVolumes, poses: Registration, n_views: int, tiling: Tiling) -> PriorVolume:
        """V_prior (Eq. 7).

        Args:
            volumes: result of `volumes`.
            poses: of their slices.
            n_views: see `estimate_prior`; 0 leaves the network out.
            tiling: see `estimate_prior`.
        """
        network = self.network if n_views else None
        placed = placed_template(network, poses.orientation)
        found = prior_volume(
            volumes,
            poses.gain,
            poses.weight,
            network,
            placed,
            n_views=n_views,
            tiling=tiling,
            least_squares=self.least_squares and placed is None and network is None,
        )
        release_memory()  # the largest amount that is freed at one time
        return found

    def again(self, poses: Registration, before: PriorVolume, n_views: int, tiling: Tiling) -> PriorVolume:
        """V_prior for other poses.

        Args:
            poses: with gains and weights that belong to them.
            before: the V_prior that it replaces.
            n_views: see `estimate_prior`.
            tiling: see `estimate_prior`.
        """
        return replace(self.of(self.volumes(poses), poses, n_views, tiling), accepted=before.accepted)

    def with_slices_moved(
        self, prior: PriorVolume, poses: Registration, n_moves: int, n_views: int, tiling: Tiling
    ) -> PriorVolume:
        """The slices of a single stack registered to the prior volume, and the prior volume that is made of them there.

        Args:
            prior: of the stack; returned with its own slices if these do not fit it better after a move.
            poses: that it was made with.
            n_moves: largest number of moves; a move that does not bring slices much nearer to their volume is not made.
            n_views: see `estimate_prior`.
            tiling: see `estimate_prior`.
        """
        prior = replace(prior, accepted=False)
        for _ in range(n_moves):
            before = prior.volumes
            slices, gain, nearer = register_to_prior(before.slices, prior.gain, prior.values, before.grid)
            if not nearer:
                break
            volumes = replace(self._volumes(slices, gain, poses, False), field_rms=before.field_rms)
            after = self.of(volumes, poses, n_views, tiling)
            prior = replace(after, gain=gain, scale=prior.scale * volumes.scale, accepted=True)
        return prior

    def _volumes(
        self, slices: Slices, gain: NDArray[np.float64], poses: Registration, common_bias_field: bool
    ) -> InitialVolumes:
        placed = placed_template(self.network, poses.orientation)
        box_mm = placed.box_mm() if placed else None
        return InitialVolumes.of(slices, gain, poses.weight, self.voxel_mm, box_mm, common_bias_field=common_bias_field)
