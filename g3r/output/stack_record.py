"""The part of run.json about each stack."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from g3r.acquisition.brain_mask import MaskSource
from g3r.acquisition.mask_extent import left_out_share
from g3r.acquisition.planes import Slices
from g3r.acquisition.sidecar import Axis
from g3r.acquisition.slice_profile import NOMINAL_FWHM_PIXELS, ProfileOrigin, SliceProfile, ThicknessSource
from g3r.acquisition.stacks import Stack
from g3r.errors import InputError
from g3r.registration import Registration
from g3r.registration.atlas_frame import motion_to_headers
from g3r.registration.stack_quality import StackQuality
from g3r.registration.thresholds import DOWNWEIGHTED_BELOW


@dataclass(frozen=True, kw_only=True)
class StackRecord:
    """One stack: its geometry, its PSF, and how its slices were registered.

    Attributes:
        name: name of its file.
        thickness_mm, thickness_from: slice thickness and its source: the option, the sidecar, or, if unknown, assumed
            equal to the slice spacing ("spacing").
        in_plane_fwhm_pixels: width of the PSF along the two axes of a slice.
        filled_share: of k-space, along the two axes of a slice, by the spectrum of its images; None where it shows no
            end. It determines the in-plane width, or else phase_resolution and phase_axis do.
        phase_resolution, phase_axis: None if the scanner does not state them.
        spacing_mm: distances of pixels and of slices.
        mask_from, mask_detail: source of the mask, and details of how it was made.
        mask_ml: volume of the mask.
        left_out_share: share of what the image shows that lies outside the mask, see `acquisition.mask_extent`.
        remarks: doubts about its files.
        quality, interleave, n_segments: None if the stack had no slices.
        standard_from_scanner: [4, 4] robust mean motion (RAS, mm) of its slices, from where its header puts them; None
            in scanner space, and if the stack had no slices.
    """

    name: str
    thickness_mm: float
    thickness_from: ThicknessSource = "option"
    in_plane_fwhm_pixels: tuple[float, ...] = NOMINAL_FWHM_PIXELS
    filled_share: tuple[float | None, ...] = (None, None)
    phase_resolution: float | None = None
    phase_axis: Axis | None = None
    spacing_mm: list[float] = field(default_factory=list)
    mask_from: MaskSource = "file"
    mask_detail: str = ""
    mask_ml: float = 0.0
    left_out_share: float = 0.0
    remarks: list[str] = field(default_factory=list)
    n_slices: int = 0
    quality: StackQuality | None = None
    interleave: int | None = None
    n_segments: int | None = None
    n_downweighted_slices: int = 0
    standard_from_scanner: list[list[float]] | None = None

    def profile(self) -> SliceProfile:
        """The PSF, for use in another run.

        Raises:
            InputError: the record was edited and does not have two in-plane widths or filled shares.
        """
        if len(self.in_plane_fwhm_pixels) != 2:
            raise InputError(f"{self.name}: has {len(self.in_plane_fwhm_pixels)} in-plane widths; expected 2")
        first, second = self.in_plane_fwhm_pixels
        if len(self.filled_share) != 2:
            raise InputError(f"{self.name}: has {len(self.filled_share)} filled shares; expected 2")
        along_first, along_second = self.filled_share
        return SliceProfile(
            thickness_mm=self.thickness_mm,
            in_plane_fwhm_pixels=(first, second),
            origin=ProfileOrigin(
                thickness_from=self.thickness_from,
                filled_share=(along_first, along_second),
                phase_resolution=self.phase_resolution,
                phase_axis=self.phase_axis,
            ),
        )


def mean_motion(slices: Slices) -> list[list[float]]:
    """Robust mean of the rigid motions [4, 4] (RAS, mm) that take points from where headers put them to the poses."""
    motion = motion_to_headers(slices).inverse()
    return [[round(float(x), 9) for x in row] for row in motion.matrix[0]]


def stack_records(
    stacks: Sequence[Stack],
    registration: Registration,
    qualities: Sequence[StackQuality],
    weight: np.ndarray,
    slices: Slices,
) -> list[StackRecord]:
    """One record per given stack.

    Args:
        stacks: stacks, in the order of their numbers in the slices.
        registration: has an entry for each stack with slices; a given stack may have none.
        qualities: one per stack.
        weight: [K] slice weights at the end of the fit.
        slices: [K] in their final poses.
    """
    stack_id = registration.slices.stack_id
    moved = registration.orientation is not None
    place = {int(stack): k for k, stack in enumerate(np.unique(stack_id))}
    return [
        StackRecord(
            name=stack.name,
            thickness_mm=stack.thickness_mm,
            in_plane_fwhm_pixels=stack.in_plane_fwhm_pixels,
            **vars(stack.origin),
            spacing_mm=[round(float(x), 6) for x in stack.spacing_mm],
            mask_from=stack.mask_source,
            mask_detail=stack.mask_detail,
            mask_ml=round(stack.grid.volume_ml(stack.mask), 1),
            left_out_share=round(left_out_share(stack), 3),
            remarks=list(stack.remarks),
            n_slices=int((stack_id == n).sum()),
            quality=qualities[n],
            interleave=registration.interleave[place[n]] if n in place else None,
            n_segments=registration.n_segments[place[n]] if n in place else None,
            n_downweighted_slices=int((weight[stack_id == n] < DOWNWEIGHTED_BELOW).sum()),
            standard_from_scanner=mean_motion(slices.take(slices.stack_id == n)) if moved and n in place else None,
        )
        for n, stack in enumerate(stacks)
    ]
