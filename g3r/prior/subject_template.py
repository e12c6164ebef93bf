"""The prior's atlas template for one subject: placed by the registration of the head, then fitted to the slices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.acquisition.template_fit import TemplateFit, fit_template
from g3r.geometry import VolumeGrid


@dataclass(frozen=True)
class PlacedTemplate:
    """One head of an atlas template in the frame of the slices.

    Attributes:
        volume: [I, J, K] float32, zero outside the brain.
        grid: grid of the volume, enlarged to the subject's size.
    """

    volume: NDArray[np.float32]
    grid: VolumeGrid

    @classmethod
    def of(cls, template: AtlasTemplate, weeks: float, scale: float) -> PlacedTemplate:
        """The head nearest in age, enlarged about its centre.

        Args:
            template: atlas template in the frame of the slices, which is the atlas frame.
            weeks: the subject's age, as found by registration.
            scale: factor by which a template of that age has to be enlarged.
        """
        volume = template.volume[int(np.abs(template.weeks - weeks).argmin())]
        center_mm = template.grid.world(np.argwhere(volume > 0)).mean(0)
        affine = template.affine.copy()
        affine[:3, :3] *= scale
        affine[:3, 3] = center_mm + scale * (template.affine[:3, 3] - center_mm)
        return cls(volume, VolumeGrid(volume.shape, affine))

    def box_mm(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest corner of its brain, [3] each."""
        inside = self.grid.world(np.argwhere(self.volume > 0))
        return inside.min(0), inside.max(0)

    def fitted(
        self, head: NDArray[np.float32], share: NDArray[np.float32], density: NDArray[np.float32], grid: VolumeGrid
    ) -> TemplateFit:
        """The template fitted to the seen voxels of a head.

        Args:
            head: [I, J, K] V_sharp.
            share: [I, J, K] share of the density whose masks say brain.
            density: [I, J, K] M_rho.
            grid: grid of all three.
        """
        return fit_template(self.volume, self.grid, head, share, np.minimum(density, 1), grid)
