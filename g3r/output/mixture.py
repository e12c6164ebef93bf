"""The written volume as a mixture of Gaussians and prior volume, corrected on voxels, on any grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.coverage import UNSEEN_BELOW, UNSEEN_POWER
from g3r.acquisition.planes import volume_from_pixels, volume_planes
from g3r.gaussians import GaussianCloud, render
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import on_grid
from g3r.uncertainty.unseen import UnseenPart

LEAST_WEIGHT = 0.01
"""Below this weight the prior is left out of the written volume: from a density of 1.15 on."""

INSIDE = 0.5
"""A point of another grid is in a region if the region's interpolated share there is at least this."""


@dataclass(frozen=True, kw_only=True)
class Mixture:
    """Mixture of Gaussians, prior and correction that makes the written volume: V = e [V_G + w (V_prior - V_G) + D].

    e is 1 in the brain and fades to 0 at its edge. V_G are the rendered Gaussians. The weight w of V_prior is 1 where
    no slice looked and outside the support of the Gaussians, and falls with the density to its least value. D is the
    correction by the slices of both (`fitting.voxel_correction`). All intensities are those of the fit.

    Attributes:
        grid: grid of `support` and `edge`: that of the run's volume.
        support: [I, J, K] where Gaussians were fitted.
        prior: V_prior [I, J, K] on `prior_grid`.
        density: M_rho [I, J, K] on `prior_grid`.
        prior_grid: grid of `prior`, `density` and `correction`.
        least_weight: least weight of V_prior, where slices are dense.
        edge: e [I, J, K] on `grid`, how much of the volume is shown.
        cutoff_sigma: where a Gaussian ends.
        correction: D [I, J, K] on `prior_grid`; None without one.
    """

    grid: VolumeGrid
    support: NDArray[np.bool_]
    prior: NDArray[np.float32]
    density: NDArray[np.float32]
    prior_grid: VolumeGrid
    least_weight: float
    edge: NDArray[np.float16]
    cutoff_sigma: float
    correction: NDArray[np.float16] | None = None

    def density_on(self, grid: VolumeGrid) -> NDArray[np.float32]:
        """M_rho [I, J, K] on a grid; 0 where the prior's grid does not reach."""
        return on_grid(self.density, self.prior_grid, grid, outside=0.0)

    def left_to_prior(self, grid: VolumeGrid) -> NDArray[np.float32]:
        """Weight [I, J, K] of the prior by the density alone: 1 where no slice looked, the least where it is dense.

        Gaussians that no slice sees are determined only by what they have to explain elsewhere.
        """
        weight = np.exp(-UNSEEN_POWER * self.density_on(grid))
        return np.where(weight < LEAST_WEIGHT, 0, weight).clip(self.least_weight, 1).astype(np.float32)

    def seen(self, grid: VolumeGrid) -> NDArray[np.bool_]:
        """Mask [I, J, K] of the voxels that slices saw."""
        return self.density_on(grid) >= UNSEEN_BELOW

    def volume(self, cloud: GaussianCloud, grid: VolumeGrid) -> NDArray[np.float32]:
        """The volume [I, J, K] on a grid; the prior alone where the cloud is empty, before there is a fit.

        On the run's own grid this is the run's volume. On another one the Gaussians are evaluated at its points, and
        V_prior, density, correction, support and edge are interpolated from their grids.

        Args:
            cloud: the Gaussians.
            grid: grid with orthogonal axes.

        Raises:
            ValueError: a grid with sheared axes.
        """
        shown = self._shown(grid)
        prior = on_grid(self.prior, self.prior_grid, grid, outside=0.0)
        if not len(cloud):
            return prior * shown
        weight = np.where(self._region(self.support, grid), self.left_to_prior(grid), 1)
        fitted = volume_from_pixels(render(cloud, volume_planes(grid), cutoff_sigma=self.cutoff_sigma).numpy(), grid)
        return self.corrected((fitted + weight * (prior - fitted)) * shown, grid)

    def corrected(self, mixed: NDArray[np.float32], grid: VolumeGrid) -> NDArray[np.float32]:
        """The mixture of Gaussians and V_prior [I, J, K] on a grid, with the correction."""
        if self.correction is None:
            return mixed
        return mixed + on_grid(self.correction, self.prior_grid, grid, outside=0.0) * self._shown(grid)

    def reach(self) -> NDArray[np.float32]:
        """Share [I, J, K] on `prior_grid` of a correction that is applied: 0 without Gaussians or without slices."""
        left = np.exp(-UNSEEN_POWER * self.density)
        return (self._region(self.support, self.prior_grid) * (1 - left)).astype(np.float32)

    def _shown(self, grid: VolumeGrid) -> NDArray[np.float32]:
        """The edge [I, J, K] on a grid: how much of the volume is shown."""
        return on_grid(self.edge, self.grid, grid, outside=0.0)

    def _region(self, inside: NDArray[np.bool_], grid: VolumeGrid) -> NDArray[np.bool_]:
        """A region of the run's grid on another one."""
        return on_grid(inside.astype(np.float32), self.grid, grid, outside=0.0) >= INSIDE


@dataclass(frozen=True, kw_only=True)
class FinishedVolume:
    """The volume [I, J, K] in intensities of the fit, the brain's mask on the same grid, and the unseen part."""

    volume: NDArray[np.float32]
    mask: NDArray[np.bool_]
    grid: VolumeGrid
    unseen: UnseenPart
