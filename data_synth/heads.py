"""Heads to learn from: atlas subjects or phantoms, centred, with their gestational age."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import center_of_mass

from data_synth.atlas import AtlasSubject, TruthVolume, cropped, load_subject
from data_synth.phantom import fetal_brain_phantom
from g3r.errors import InputError
from g3r.geometry import VolumeGrid

WEEKS_RANGE = (15.0, 45.0)
"""Gestational ages that a number in a subject's name may mean."""


@dataclass(frozen=True)
class PhantomSubject:
    """A phantom to be made: gestational age (weeks) and seed."""

    name: str
    weeks: float
    seed: int


Subject = AtlasSubject | PhantomSubject


def phantom_subjects(n: int, seed: int, split: str) -> list[PhantomSubject]:
    """N phantoms with ages spread evenly over 21 to 38 weeks; `split` separates training from validation."""
    first = 10_000 * seed + (5_000 if split == "validation" else 0)
    ages = 21 + 17 * (np.arange(n) + 0.5) / n
    return [PhantomSubject(f"phantom-{w:.1f}w-{first + k}", float(w), first + k) for k, w in enumerate(ages)]


def weeks_of(subject: Subject) -> float:
    """Gestational age in weeks: a phantom's own, or the first number in the last part of an atlas name.

    Raises:
        InputError: no number that can be an age, as in `sta27` or `sb23-notoperated`.
    """
    if isinstance(subject, PhantomSubject):
        return subject.weeks
    found = re.search(r"\d+(\.\d+)?", subject.name.rsplit("/", 1)[-1])
    low, high = WEEKS_RANGE
    if found is None or not low <= float(found[0]) <= high:
        raise InputError(
            f"{subject.image}: no gestational age in the name {subject.name!r}; expected a number of weeks "
            f"between {low:g} and {high:g}, as in sta27; rename the folder"
        )
    return float(found[0])


def load_volume_of(subject: Subject, spacing_mm: float) -> TruthVolume:
    """The subject's normalised volume at an isotropic voxel size; for errors see `load_subject`."""
    if isinstance(subject, AtlasSubject):
        return load_subject(subject, spacing_mm)
    made = fetal_brain_phantom(subject.weeks, spacing_mm, subject.seed)
    bright = float(np.percentile(made.t2[made.mask], 99.5))
    return TruthVolume(subject.name, made.t2 / np.float32(bright), made.mask, made.affine)


def load_head(subject: Subject, spacing_mm: float, margin_voxels: int = 3) -> TruthVolume:
    """The subject in the atlas frame: cropped, zero outside the mask, the mask's centroid at the origin."""
    volume = cropped(load_volume_of(subject, spacing_mm), margin_voxels)
    centroid_mm = VolumeGrid(volume.data.shape, volume.affine).world(center_of_mass(volume.mask))
    affine = volume.affine.copy()
    affine[:3, 3] -= centroid_mm
    return replace(volume, data=np.where(volume.mask, volume.data, np.float32(0)), affine=affine)
