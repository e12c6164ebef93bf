"""Masks by the mask network."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from g3r.acquisition.brain_mask import FoundMask
from g3r.acquisition.file_axes import FileAxes, settled
from g3r.acquisition.images import Volume
from g3r.acquisition.slice_axis import find_slice_axis
from g3r.mask_network.inference import find_brain
from g3r.mask_network.model import MaskModel


@dataclass(frozen=True)
class AutomaticMask:
    """The mask network as a masker.

    Args:
        model: trained mask network.
    """

    model: MaskModel

    def mask_of(self, path: str | os.PathLike[str], volume: Volume) -> FoundMask | str:
        """The brain in a stack, or why none was found.

        Args:
            path: of the stack, whose sidecar may tell its slice axis.
            volume: image read from it.
        """
        axes = FileAxes.of(volume.grid, find_slice_axis(path, volume.grid.spacing_mm).axis)
        spacing_mm = settled(axes.grid_from_file(volume.grid)).spacing_mm
        image = np.nan_to_num(axes.from_file(volume.data), posinf=0.0, neginf=0.0)
        found = find_brain(image, spacing_mm.tolist(), self.model)
        if not found.found:
            return found.reason
        detail = f"{self.model.file_name}, probability of a head {found.presence:.2f}"
        return FoundMask(inside=axes.to_file(found.mask), source="automatic", detail=detail)
