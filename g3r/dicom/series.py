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
"""Names of planes by the axis of the patient's frame that is nearest to the normal."""

SAME_DIRECTION = 1e-3
"""Largest difference of direction cosines within a stack: about 0.06 degrees."""

SAME_PLACE_MM = 0.01
"""Two images closer than this show the same slice."""

MISSING_FROM, UNEVEN_FROM = 1.5, 1.02
"""Slices are missing where a distance exceeds the first number times the usual one. The slice spacing is uneven if the
largest distance exceeds the second number times the smallest."""

SHOWN_TILT_DEGREES = 3

MAX_NAMED = 10
"""Most missing slices that are listed one by one."""


@dataclass(frozen=True)
class Series:
    """A DICOM series.

    Args:
        label: name by which it is requested: its number, with a letter if several series have that number.
        images: all images, in the order in which they were read.
    """

    label: str
    images: tuple[ImageHeader, ...]

    @property
    def name(self) -> str:
        """Name of its file, also in messages and results; free of patient data."""
        return f"series-{self.label}"

    @property
    def first(self) -> ImageHeader:
        """The image from which the common properties of the series are taken."""
        return self.images[0]

    @property
    def n_images(self) -> int:
        """Number of images."""
        return len(self.images)

    @property
    def is_placed(self) -> bool:
        """Whether every image has a position and an orientation."""
        return all(image.position_mm is not None and image.axes is not None for image in self.images)

    @cached_property
    def n_directions(self) -> int:
        """Number of different slice orientations; 0 if any is unknown."""
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
        """Normal [3] of the first slice, in the patient's frame; only if `is_placed`."""
        assert self.first.axes is not None
        return np.cross(*self.first.axes)

    @cached_property
    def by_place(self) -> list[ImageHeader]:
        """The images in order along the normal; only if `is_placed`."""
        return sorted(self.images, key=self._height_mm)

    @cached_property
    def steps_mm(self) -> NDArray[np.float64]:
        """Distances of neighbouring slices [n_images - 1]; only if `is_placed`."""
        return np.diff([self._height_mm(image) for image in self.by_place])

    def _height_mm(self, image: ImageHeader) -> float:
        """Position of an image along the normal."""
        assert image.position_mm is not None
        return float(self.normal @ image.position_mm)

    @property
    def spacing_mm(self) -> float | None:
        """Median distance of neighbouring slices; None without one orientation or with a single slice."""
        if self.n_directions != 1 or self.n_images < 2:
            return None
        return float(np.median(self.steps_mm))

    @property
    def thickness_mm(self) -> float | None:
        """Slice thickness; None if the header does not state it."""
        return self.first.thickness_mm

    @property
    def plane(self) -> str:
        """The plane in words, such as "axial" or "coronal, 12 degrees off"."""
        if self.n_directions != 1:
            return f"{self.n_directions} planes" if self.n_directions else "-"
        along = int(np.argmax(np.abs(self.normal)))
        tilt = np.degrees(np.arccos(min(1.0, float(np.abs(self.normal[along])))))
        return PLANES[along] + (f", {tilt:.0f}° off" if tilt >= SHOWN_TILT_DEGREES else "")

    def missing(self) -> str | None:
        """Missing slices in words, by gaps between places; None if there are none. Missing ends cannot be detected."""
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
        """Missing image numbers between the first and the last."""
        found = {int(image.instance_number) for image in self.images if image.instance_number is not None}
        if not found or max(found) - min(found) > len(found) + MAX_NAMED:
            return []
        return sorted(set(range(min(found), max(found) + 1)) - found)


def _counted(numbers: Sequence[int]) -> str:
    return f"slice{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}"


def grouped(images: Sequence[ImageHeader]) -> list[Series]:
    """Images grouped into series, in order of their numbers; those with the same number in order of acquisition."""
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
    """The suffix for an index from 0: a, b, ... y, za, zb, ... in alphabetical order."""
    return "z" * (n // 25) + ascii_lowercase[n % 25]
