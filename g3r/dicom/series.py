"""A DICOM series as a stack of slices: its plane, its spacing, and which slices are missing."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from string import ascii_lowercase

import numpy as np
from numpy.typing import NDArray

from g3r.dicom.headers import ImageHeader

PLANES = ("sagittal", "coronal", "axial")
"""By the axis of the patient's frame that is nearest to the normal."""

SAME_DIRECTION = 1e-3
"""Largest difference of direction cosines within a stack: about 0.06 degrees."""

SAME_PLACE_MM = 0.01
"""Two slices nearer than this are one slice, imaged twice."""

MISSING_FROM, UNEVEN_FROM = 1.5, 1.02
"""A distance this many times the usual one is a hole; one above the second is not even."""

SHOWN_TILT_DEGREES = 3

MAX_NAMED = 10
"""Missing slices that are named one by one."""


@dataclass(frozen=True)
class Series:
    """A series.

    Args:
        label: by which it is asked for: its number, with a letter where several have the same.
        images: all of them, in the order in which they were read.
    """

    label: str
    images: tuple[ImageHeader, ...]

    @property
    def name(self) -> str:
        """Of its file, and in messages and results; says nothing of the patient."""
        return f"series-{self.label}"

    @property
    def first(self) -> ImageHeader:
        """The image that speaks for all in what a series has in common."""
        return self.images[0]

    @property
    def n_images(self) -> int:
        """How many images there are."""
        return len(self.images)

    @property
    def is_placed(self) -> bool:
        """Whether every image says where it is."""
        return all(image.position_mm is not None and image.axes is not None for image in self.images)

    @cached_property
    def n_directions(self) -> int:
        """How many directions the slices have; 0 where they do not say it."""
        if not self.is_placed:
            return 0
        found: list[NDArray[np.float64]] = []
        for image in self.images:
            assert image.axes is not None
            if not any(np.abs(image.axes - other).max() < SAME_DIRECTION for other in found):
                found.append(image.axes)
        return len(found)

    @cached_property
    def normal(self) -> NDArray[np.float64]:
        """Of the first slice [3], in the patient's frame; only where it is placed."""
        assert self.first.axes is not None
        return np.cross(*self.first.axes)

    @cached_property
    def by_place(self) -> list[ImageHeader]:
        """The images along the normal; only where they are placed."""
        return sorted(self.images, key=self._height_mm)

    @cached_property
    def steps_mm(self) -> NDArray[np.float64]:
        """Distances of neighbouring slices [n_images - 1]; only where they are placed."""
        return np.diff([self._height_mm(image) for image in self.by_place])

    def _height_mm(self, image: ImageHeader) -> float:
        """The place of an image along the normal."""
        assert image.position_mm is not None
        return float(self.normal @ image.position_mm)

    @property
    def spacing_mm(self) -> float | None:
        """The usual distance of slices; None where there is none."""
        if self.n_directions != 1 or self.n_images < 2:
            return None
        return float(np.median(self.steps_mm))

    @property
    def thickness_mm(self) -> float | None:
        """Of a slice; None where the header does not say it."""
        return self.first.thickness_mm

    @property
    def plane(self) -> str:
        """In words, such as "axial" or "coronal, 12 degrees off"."""
        if self.n_directions != 1:
            return f"{self.n_directions} planes" if self.n_directions else "-"
        along = int(np.argmax(np.abs(self.normal)))
        tilt = np.degrees(np.arccos(min(1.0, float(np.abs(self.normal[along])))))
        return PLANES[along] + (f", {tilt:.0f}° off" if tilt >= SHOWN_TILT_DEGREES else "")

    def missing(self) -> str | None:
        """Which slices are missing, as far as places tell; None where none is. Missing ends cannot be seen."""
        usual_mm = self.spacing_mm
        if usual_mm is None or usual_mm < SAME_PLACE_MM:
            return None
        n_missing = np.where(self.steps_mm > MISSING_FROM * usual_mm, np.rint(self.steps_mm / usual_mm) - 1, 0)
        if not n_missing.any():
            return None
        n_whole = self.n_images + int(n_missing.sum())
        if n_missing.sum() > MAX_NAMED:
            return f"{n_missing.sum():.0f} of {n_whole} slices are missing"
        places = np.cumsum(np.concatenate([[1], n_missing + 1])).astype(int)
        absent = sorted(set(range(1, n_whole + 1)) - set(places.tolist()))
        text = f"{_counted(absent)} of {n_whole} {'is' if len(absent) == 1 else 'are'} missing"
        numbers = self._absent_numbers()
        if len(numbers) == len(absent):
            text += f" (image number {', '.join(map(str, numbers))})"
        return text

    def _absent_numbers(self) -> list[int]:
        """Image numbers between the first and the last that no image has."""
        found = {int(image.instance_number) for image in self.images if image.instance_number is not None}
        if not found or max(found) - min(found) > len(found) + MAX_NAMED:
            return []
        return sorted(set(range(min(found), max(found) + 1)) - found)


def _counted(numbers: Sequence[int]) -> str:
    return f"slice{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}"


def grouped(images: Sequence[ImageHeader]) -> list[Series]:
    """The series that images belong to, by number; those of one number in the order of acquisition."""
    by_uid: dict[str, list[ImageHeader]] = defaultdict(list)
    for image in images:
        by_uid[image.series_uid].append(image)
    by_number: dict[int, list[tuple[ImageHeader, ...]]] = defaultdict(list)
    for own in by_uid.values():
        by_number[int(own[0].number or 0)].append(tuple(own))
    series = []
    for number, several in sorted(by_number.items()):
        several.sort(key=lambda own: (own[0].acquired_on, own[0].acquired_at, own[0].series_uid))
        labels = [str(number)] if len(several) == 1 else [f"{number}{_letters(n)}" for n in range(len(several))]
        series += [Series(label, own) for label, own in zip(labels, several, strict=True)]
    return series


def _letters(n: int) -> str:
    """The letters a, b, ... z, za, zb, ... by number from 0."""
    return "z" * (n // 25) + ascii_lowercase[n % 25]
