"""Training heads: atlas subjects or phantoms, centred, with their gestational age."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import center_of_mass

from data_synth.atlas import AtlasSubject, TruthVolume, cropped, find_subjects, load_subject
from data_synth.phantom import LABELS, fetal_brain_phantom
from g3r.errors import InputError
from g3r.geometry import VolumeGrid

logger = logging.getLogger(__name__)

N_PHANTOMS = 24
"""Number of phantoms made for training; augmentation varies each further."""

MARGIN_VOXELS = 3
"""Background around a head."""

WEEKS_RANGE = (15.0, 45.0)
"""Range of gestational ages that are accepted from a name."""

WEEKS_IN_NAME = re.compile(
    r"(?<![a-z])(?:sta|sb|ga|weeks?)[-_]?(\d+(?:\.\d+)?)"  # sta27, sb23-notoperated, ga-31.5, week27, weeks-27
    r"|(?<![\d.])(\d+(?:\.\d+)?)[-_]?w(?:eeks?)?(?![a-z])",  # 27w, 27-weeks
    re.IGNORECASE,
)
"""Pattern of an age in a name. It requires a marker such as `ga` or `w`, because a bare number is more often a subject
number (`sub-020`, `case31`)."""


@dataclass(frozen=True)
class PhantomSubject:
    """A phantom to be made: gestational age (weeks) and seed."""

    name: str
    weeks: float
    seed: int


Subject = AtlasSubject | PhantomSubject


def phantom_subjects(n: int, seed: int, split: str) -> list[PhantomSubject]:
    """Phantoms with ages spread evenly over 21 to 38 weeks.

    Args:
        n: number of phantoms.
        seed: of their shapes.
        split: `training` or `validation`; the two have no phantom in common.
    """
    first = 10_000 * seed + (5_000 if split == "validation" else 0)
    ages = 21 + 17 * (np.arange(n) + 0.5) / n
    return [PhantomSubject(f"phantom-{w:.1f}w-{first + k}", float(w), first + k) for k, w in enumerate(ages)]


def training_and_validation(
    source: str,
    include: Sequence[str] | None,
    exclude: Sequence[str] | None,
    val_include: Sequence[str] | None,
    *,
    n_val_phantoms: int,
    seed: int,
) -> tuple[list[Subject], list[Subject]]:
    """Training and validation subjects.

    Args:
        source: `phantom`, or an atlas folder.
        include: glob patterns of names for training; None takes all.
        exclude: glob patterns of names to use neither for training nor for validation.
        val_include: glob patterns of names for validation, which are excluded from training. Without patterns the
            training subjects are used for validation too, with a warning.
        n_val_phantoms: number of validation phantoms.
        seed: of the phantoms.

    Raises:
        InputError: no such folder, or nothing in it passes the patterns.
    """
    if source == "phantom":
        return (
            [*phantom_subjects(N_PHANTOMS, seed, "training")],
            [*phantom_subjects(n_val_phantoms, seed, "validation")],
        )
    train: list[Subject] = [*find_subjects(source, include or (), [*(exclude or ()), *(val_include or ())])]
    if val_include:
        return train, [*find_subjects(source, val_include, exclude or ())]
    logger.warning("no val_include given: validating on other simulations of the training subjects")
    return train, [*train]


USUAL_WEEKS = 30.0
"""Age assumed for heads of unknown age, where a rough value is enough."""


def weeks_of(subject: Subject, otherwise: float | None = None) -> float:
    """Gestational age in weeks: a phantom's own, or the first age found in the last part of an atlas subject's path.

    Args:
        subject: with a name.
        otherwise: age of a subject whose name has none.

    Raises:
        InputError: no age as in `sta27`, `sb23-notoperated`, `ga-31.5`, `week27` or `27w`, and no `otherwise`.
    """
    if isinstance(subject, PhantomSubject):
        return subject.weeks
    low, high = WEEKS_RANGE
    for found in WEEKS_IN_NAME.finditer(subject.name.rsplit("/", 1)[-1]):
        weeks = float(found[1] or found[2])
        if low <= weeks <= high:
            return weeks
    if otherwise is not None:
        return otherwise
    raise InputError(
        f"{subject.image}: no gestational age in the name {subject.name!r}; expected weeks between {low:g} and "
        f"{high:g} as in sta27, sb23, ga-31.5, week27 or 27w; rename the folder, or the file where it has the name"
    )


def load_volume_of(subject: Subject, spacing_mm: float | None) -> TruthVolume:
    """The subject's normalised volume at an isotropic voxel size; for errors see `load_subject`.

    A `spacing_mm` of None keeps the grid of an atlas subject. A phantom has no grid of its own and needs a value.
    """
    if isinstance(subject, AtlasSubject):
        return load_subject(subject, spacing_mm)
    assert spacing_mm is not None
    made = fetal_brain_phantom(subject.weeks, spacing_mm, subject.seed)
    bright = float(np.percentile(made.t2[made.mask], 99.5))
    return TruthVolume(
        name=subject.name,
        data=made.t2 / np.float32(bright),
        mask=made.mask,
        affine=made.affine,
        labels=made.labels,
        ventricles=made.labels == LABELS["ventricles"],
    )


def load_head(subject: Subject, spacing_mm: float) -> TruthVolume:
    """The subject in the atlas frame: cropped, zero outside the mask, the mask's centroid at the origin.

    Args:
        subject: for errors see `load_subject`.
        spacing_mm: isotropic voxel size.
    """
    volume = cropped(load_volume_of(subject, spacing_mm), MARGIN_VOXELS)
    centroid_mm = VolumeGrid(volume.data.shape, volume.affine).world(center_of_mass(volume.mask))
    affine = volume.affine.copy()
    affine[:3, 3] -= centroid_mm
    return replace(volume, data=np.where(volume.mask, volume.data, np.float32(0)), affine=affine)
