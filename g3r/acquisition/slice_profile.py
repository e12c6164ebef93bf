"""Thickness and PSF of a stack, and their source: an option, the sidecar, or the header's spacing."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from g3r.acquisition.psf import IN_PLANE_FWHM_PIXELS, partial_fwhm_pixels
from g3r.acquisition.sidecar import AXES, Axis, Sidecar, read_sidecar, sidecar_path
from g3r.errors import InputError

logger = logging.getLogger(__name__)

LENGTHS_AGREE = 0.02
"""Largest relative difference of two lengths that count as equal: sidecars round to a hundredth of a mm or so."""

NOMINAL_FWHM_PIXELS = (IN_PLANE_FWHM_PIXELS, IN_PLANE_FWHM_PIXELS)

ThicknessSource = Literal["option", "sidecar", "header", "spacing"]
"""Source of the thickness: the user, the scanner, the headers of single slices, or, if unknown, assumed equal to the
slice spacing."""


@dataclass(frozen=True, kw_only=True)
class ProfileOrigin:
    """Source of the PSF of a stack.

    Attributes:
        thickness_from: source of the thickness.
        filled_share: of k-space, along the two axes of the slices' images, by their spectrum; None: it shows no end.
        phase_resolution: share of k-space that was filled along the phase-encoding axis, by the sidecar; None: not
            known.
        phase_axis: the phase-encoding axis of the image file; None: not known.
    """

    thickness_from: ThicknessSource = "option"
    filled_share: tuple[float | None, float | None] = (None, None)
    phase_resolution: float | None = None
    phase_axis: Axis | None = None


NOT_SAID = ProfileOrigin()
"""Origin for a stack that is made with its thickness, without anything from a scanner."""


@dataclass(frozen=True, kw_only=True)
class SliceProfile:
    """Thickness and in-plane FWHM, which determine the PSF of a stack.

    Attributes:
        thickness_mm: of a slice.
        in_plane_fwhm_pixels: along the two axes of the slices' images.
        origin: their source.
    """

    thickness_mm: float
    in_plane_fwhm_pixels: tuple[float, float] = NOMINAL_FWHM_PIXELS
    origin: ProfileOrigin = NOT_SAID

    def line(self) -> str:
        """One line for the terminal."""
        text = f"thickness {self.thickness_mm:.4g} mm ({self.origin.thickness_from})"
        p, axis = self.origin.phase_resolution, self.origin.phase_axis
        if self.in_plane_fwhm_pixels != NOMINAL_FWHM_PIXELS:
            text += ", in-plane FWHM {:.3g} x {:.3g} pixels".format(*self.in_plane_fwhm_pixels)
        if self.origin.filled_share != (None, None):
            text += ", k-space filled to {:g} x {:g}".format(*(share or 1 for share in self.origin.filled_share))
        if p is not None and p < 1:
            text += f", phase resolution {p:g} " + (f"along {axis}" if axis else "of an unknown axis, not used")
        return text


def find_slice_profile(
    path: str | os.PathLike[str],
    spacing_mm: ArrayLike,
    slice_axis: int,
    thickness_mm: float | None = None,
    earlier: SliceProfile | None = None,
    filled_share: tuple[float | None, float | None] = (None, None),
) -> SliceProfile:
    """The profile of a stack's slices; a line about it is logged.

    Args:
        path: of the image; its sidecar is beside it.
        spacing_mm: [3] along the axes of the file.
        slice_axis: the axis of the file, 0 to 2, along which slices are counted.
        thickness_mm: the user's; it wins over everything else.
        earlier: profile of the run that is repeated, in place of the sidecar's and the spectrum's.
        filled_share: of k-space by the spectrum of the images, see `ProfileOrigin`; it wins over the sidecar's.

    Raises:
        InputError: a sidecar that cannot be used, or one with another slice spacing than the image's.
    """
    name = Path(path).name
    if earlier is None:
        slice_spacing_mm = float(np.asarray(spacing_mm)[slice_axis])
        sidecar = read_sidecar(sidecar_path(path))
        if sidecar is not None:
            _check_slice_spacing(sidecar, slice_spacing_mm, name)
        thickness_mm, source = _thickness(sidecar, slice_spacing_mm, thickness_mm, name)
        profile = _profile(thickness_mm, source, sidecar, slice_axis, filled_share)
    elif thickness_mm is None:
        profile = earlier
    else:
        profile = replace(earlier, thickness_mm=thickness_mm, origin=replace(earlier.origin, thickness_from="option"))
    logger.info("%s: %s", name, profile.line())
    if profile.origin.thickness_from == "spacing":
        logger.warning(
            "%s: slice thickness taken as the distance of slices, %.2f mm, which is too much where there are gaps; "
            "pass --thickness, or put the scanner's %s beside the image",
            name,
            profile.thickness_mm,
            sidecar_path(path).name,
        )
    return profile


def _check_slice_spacing(sidecar: Sidecar, slice_spacing_mm: float, name: str) -> None:
    """Raise `InputError` for a sidecar whose slices are not as far apart as the image's."""
    said_mm = sidecar.spacing_mm
    if said_mm is not None and not _agree(said_mm, slice_spacing_mm):
        raise InputError(
            f"{sidecar.name}: SpacingBetweenSlices is {said_mm:g} mm; expected the {slice_spacing_mm:.4g} mm between "
            f"slices of {name} by its header, pass the image that the file is of, or remove the file"
        )


def _thickness(
    sidecar: Sidecar | None, slice_spacing_mm: float, given_mm: float | None, name: str
) -> tuple[float, ThicknessSource]:
    """Thickness and its source.

    Args:
        sidecar: None if there is none.
        slice_spacing_mm: between slices by the header.
        given_mm: by the user.
        name: of the image, for messages.
    """
    said_mm = None if sidecar is None else sidecar.thickness_mm
    if given_mm is not None:
        if sidecar is not None and said_mm is not None and not _agree(given_mm, said_mm):
            logger.warning(
                "%s: thickness %g mm is taken as given; the scanner says %g mm (%s)",
                name,
                given_mm,
                said_mm,
                sidecar.name,
            )
        return given_mm, "option"
    return (slice_spacing_mm, "spacing") if said_mm is None else (said_mm, "sidecar")


def _profile(
    thickness_mm: float,
    source: ThicknessSource,
    sidecar: Sidecar | None,
    slice_axis: int,
    filled_share: tuple[float | None, float | None],
) -> SliceProfile:
    """The profile, wider in plane where spectrum or sidecar say that k-space was filled in part.

    Args:
        thickness_mm: of a slice.
        source: of the thickness.
        sidecar: None if there is none.
        slice_axis: of the file.
        filled_share: see `find_slice_profile`.
    """
    share = list(filled_share)
    phase_resolution, axis = None, None
    if sidecar is not None:
        phase_resolution, axis = sidecar.phase_resolution, sidecar.phase_axis_of(slice_axis)
        if axis is not None and AXES.index(axis) == slice_axis:
            # slices that are excited one by one are encoded in their plane: the file or its axes were changed
            if phase_resolution is not None:
                logger.warning(
                    "%s: phase encoding along %s, which counts the slices; it is not used", sidecar.name, axis
                )
            axis = None
        if axis is not None:
            place = [letter for n, letter in enumerate(AXES) if n != slice_axis].index(axis)
            share[place] = share[place] or phase_resolution
    first, second = (partial_fwhm_pixels(one or 1.0) for one in share)
    return SliceProfile(
        thickness_mm=thickness_mm,
        in_plane_fwhm_pixels=(first, second),
        origin=ProfileOrigin(
            thickness_from=source, filled_share=filled_share, phase_resolution=phase_resolution, phase_axis=axis
        ),
    )


def _agree(one_mm: float, other_mm: float) -> bool:
    """Whether two lengths are the same; an invalid length (a thickness of 0) agrees with nothing."""
    return abs(one_mm - other_mm) <= LENGTHS_AGREE * abs(other_mm)
