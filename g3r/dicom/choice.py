"""Choice of the series of an examination that are stacks of T2-weighted slices, with reasons against the others."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from g3r.dicom.headers import ImageHeader
from g3r.dicom.series import SAME_PLACE_MM, UNEVEN_FROM, Series
from g3r.errors import InputError

MIN_SLICES = 8
"""Least slices of a chosen stack: a brain of 20 weeks is 40 mm high, and slices are at most 5 mm apart."""

MIN_ECHO_TIME_MS = 50.0
"""Fetal T2-weighted protocols have 80 to 180 ms; proton density and T1 are below 40 ms."""

LOCALISER = re.compile(r"locali[sz]|scout|survey|\bloc\b|calib|smart ?brain|\baahead\b", re.IGNORECASE)
"""Words in the description or protocol of localisers."""

ORIGINAL, PRIMARY = "ORIGINAL", "PRIMARY"


@dataclass(frozen=True, kw_only=True)
class Judged:
    """A series with the decision whether it is taken.

    Attributes:
        series: the judged series.
        is_taken: whether it becomes a stack.
        reason: why it is not taken, or that it was asked for.
        is_broken: whether only a fault of its images keeps it from being taken, not its kind.
    """

    series: Series
    is_taken: bool
    reason: str = ""
    is_broken: bool = False


def judged(all_series: Sequence[Series], asked_for: Sequence[str] | None = None) -> list[Judged]:
    """Every series with its decision, in the given order.

    Args:
        all_series: all series of a folder.
        asked_for: labels of the series to take; None chooses by the rules.

    Raises:
        InputError: a requested series does not exist, or cannot be a stack.
    """
    if asked_for is None:
        return _without_repeats([_by_rules(series) for series in all_series])
    labels = [series.label for series in all_series]
    for label in asked_for:
        if label not in labels:
            same = [one for one in labels if one.rstrip("abcdefghijklmnopqrstuvwxyz") == label]
            what = f"several series have this number, choose from {', '.join(same)}" if same else "is not there"
            raise InputError(f"--series {label}: {what}; the folder has series {', '.join(labels)}")
    verdicts = []
    for series in all_series:
        wanted = series.label in asked_for
        fault = _fault(series)
        if wanted and fault:
            raise InputError(f"--series {series.label}: {fault}; leave it out, or export the series again")
        verdicts.append(Judged(series=series, is_taken=wanted, reason="asked for" if wanted else "not asked for"))
    return verdicts


def check_one_examination(taken: Sequence[Series], folder: str) -> None:
    """Raise `InputError` if series are of several patients or examinations, because one head is reconstructed."""
    for what, values in (
        ("patients", {image.patient_id for series in taken for image in series.images}),
        ("examinations", {image.study_uid for series in taken for image in series.images}),
    ):
        if len(values) > 1:
            raise InputError(
                f"{folder}: its T2-weighted series are of {len(values)} {what}; expected one, pass the folder of one "
                "examination, or choose with --series"
            )


def _by_rules(series: Series) -> Judged:
    unsuited, fault = _unsuited(series), _fault(series)
    broken = fault is not None and unsuited is None
    return Judged(series=series, is_taken=not (unsuited or fault), reason=unsuited or fault or "", is_broken=broken)


def _unsuited(series: Series) -> str | None:
    """The reason why a series is of an unsuitable kind; None if it is suitable."""
    first = series.first
    names = re.sub(r"[_\-.]", " ", f"{first.description} {first.protocol}")
    kinds = {kind.upper() for kind in first.image_type}
    sequence = {word.upper() for word in first.scanning_sequence}
    reasons = (
        (first.modality != "MR", f"not MR but {first.modality or 'unknown'}"),
        ("LOCALIZER" in kinds or LOCALISER.search(names) or series.n_directions > 1, "localiser"),
        (not first.image_type, "does not say whether it is original"),
        (not kinds >= {ORIGINAL, PRIMARY}, "derived"),
        (first.acquisition_type == "3D", "3D acquisition"),
        (not sequence, "does not say which sequence it is of"),
        ("EP" in sequence, "echo-planar"),
        ("GR" in sequence, "gradient echo"),
        ("IR" in sequence, "inversion recovery"),
        ("SE" not in sequence, "no spin echo"),
        (first.echo_time_ms is None, "does not say its echo time"),
        ((first.echo_time_ms or 0) < MIN_ECHO_TIME_MS, f"not T2-weighted (TE {first.echo_time_ms or 0:g} ms)"),
        (series.n_images < MIN_SLICES, f"fewer than {MIN_SLICES} slices"),
    )
    return next((reason for applies, reason in reasons if applies), None)


def _fault(series: Series) -> str | None:
    """The reason why a series cannot be a stack, whatever it shows; None if it can."""
    cut = [image for image in series.images if image.is_cut]
    if any((image.n_frames or 1) > 1 for image in series.images):
        return "multi-frame images, which are not read here (convert them with dcm2niix, then pass --stacks)"
    if not series.is_placed:
        return "its images do not say where they are"
    if series.n_directions > 1:
        return f"its slices have {series.n_directions} directions"
    if len({(image.rows, image.columns) for image in series.images}) > 1:
        return "its images have several sizes"
    if cut:
        return f"the file of image number {cut[0].instance_number or 0:.0f} is cut off"
    if series.n_images < 2:
        return "a single slice"
    if (series.steps_mm < SAME_PLACE_MM).any():
        return "several images of one slice (echoes or repetitions)"
    if missing := series.missing():
        return missing
    if series.steps_mm.max() > UNEVEN_FROM * series.steps_mm.min():
        return f"slices are {series.steps_mm.min():.4g} to {series.steps_mm.max():.4g} mm apart"
    return None


def _without_repeats(verdicts: list[Judged]) -> list[Judged]:
    """Drop repeats: scanners may store an acquisition twice, with and without a filter."""
    kept: dict[tuple[object, ...], Series] = {}
    for one in sorted((one for one in verdicts if one.is_taken), key=lambda one: "ND" in one.series.first.image_type):
        kept.setdefault(_acquisition(one.series), one.series)
    found = []
    for one in verdicts:
        other = kept[_acquisition(one.series)] if one.is_taken else one.series
        # copies have other image types; stacks of the same type are others, whose times were removed
        if other is one.series or other.first.image_type == one.series.first.image_type:
            found.append(one)
        else:
            reason = f"same acquisition as series {other.label}"
            found.append(Judged(series=one.series, is_taken=False, reason=reason))
    return found


def _acquisition(series: Series) -> tuple[object, ...]:
    """A key that only copies of one acquisition share; the UID of the series if its headers have no times."""
    if not all(image.acquired_at for image in series.images):
        return (series.first.series_uid,)
    return tuple((image.acquired_on, image.acquired_at, *_plane(image)) for image in series.by_place)


def _plane(image: ImageHeader) -> tuple[float, ...]:
    """Position and axes of an image that has them, rounded."""
    assert image.position_mm is not None
    assert image.axes is not None
    return (*np.round(image.position_mm, 1).tolist(), *np.round(image.axes, 3).ravel().tolist())
