"""Area of the head along the normal of each stack, with missing slices filled in.

A mask covers only what was acquired. Slices that are missing inside a stack are interpolated between their neighbours.
If a stack ends in a large slice, its field of view cut the head: the rest is continued as an ellipsoid, whose length
is taken from stacks that show it in plane. A mask far too wide for a brain in black counts by what is not black.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import slice_spacing_mm, steps_along_normal_mm

MIN_MISSING_AREA = 0.2
"""Slices missing between others count from this share of the largest area. Smaller ones are at the tips of the head,
where masks often lack a slice."""

MIN_CUT_AREA = 0.3
"""A stack was cut at an end whose slice is larger than this share of its largest slice. Stacks of whole heads, with up
to 4 mm between slices, end at 0 to 0.19 of it; a field of view that lacks a tenth of the head ends at 0.36."""

MIN_CUT_SHARE = 0.05
"""Share of a head beyond its field of view that counts. In slices of 5 mm the outermost one of a whole head may have
`MIN_CUT_AREA`, too; then next to nothing lies beyond it."""

MIN_SLICES = 6
"""Fewest acquired slices of a long stack. Whether the field of view cut the head cannot be told from fewer: such stacks
are neither cut nor whole."""

LENGTH_RATIO, LENGTH_SPREAD = 1.0, 0.2
"""Usual length of a head along the normal over the diameter of a disc of its largest area, and the standard deviation
of its logarithm: 0.85 to 1.3 for axial to coronal stacks of an ellipsoid with the proportions of a fetal brain."""

SEEN_LENGTH_SPREAD = 0.08
"""Standard deviation of the logarithm of the length, relative to the length that other stacks show in plane."""

AREA_SPREAD = 0.08
"""Standard deviation of areas from those of an ellipsoid, as a share of the largest area."""

DARK_SHARE, MAX_DARK = 0.3, 0.2
"""Share of the third quartile of the masked pixels below which one is dark, and largest share of such pixels that a
mask of a brain has. Three real stacks have 0.01 to 0.02 of them, 0.04 with masks that are 9 mm too wide. In images that
are black beside the brain masks have more than 0.2 if they are about 5 mm too wide or more."""

MIN_ANGLE_DEG = 45.0
"""Smallest angle between the normals of two stacks at which each shows the other's length in plane."""

WHOLE_VOLUME_SPREAD = 0.08
"""Standard deviation of the logarithm of a cut stack's continued volume, relative to stacks of whole heads."""

MAX_AREA_GAIN = 1.25
"""Upper bound of a head's largest area over the largest that a cut stack shows: 1.2 where it lacks 70 % of length."""

MAX_LENGTH_GAIN = 2.5
"""Upper bound of a head's length over the length that was seen."""


@dataclass(frozen=True, kw_only=True)
class AreaProfile:
    """Masked area of each slice of one stack by the header, missing slices included.

    Args:
        index: [N] numbers of the slices in their stack, ascending; may begin below zero.
        area_mm2: [N] masked area; the expected one for a missing slice.
        center_mm: [N, 3] middle of that area by the header.
        seen: [N] whether the slice was acquired.
        spacing_mm: slice spacing.
        cut: whether the field of view is known to have cut the head before the first and after the last acquired slice;
            never known of a stack of fewer than `MIN_SLICES`, which may be a fragment.
    """

    index: NDArray[np.int64]
    area_mm2: NDArray[np.float64]
    center_mm: NDArray[np.float64]
    seen: NDArray[np.bool_]
    spacing_mm: float
    cut: tuple[bool, bool]

    @property
    def volume_mm3(self) -> float:
        """Volume of the head, missing slices included."""
        return float(self.area_mm2.sum() * self.spacing_mm)

    @property
    def head_center_mm(self) -> NDArray[np.float64]:
        """Middle of the head [3] by the header, missing slices included."""
        return np.average(self.center_mm, axis=0, weights=self.area_mm2)

    @property
    def is_cut(self) -> bool:
        """Whether the field of view is known to have cut the head."""
        return any(self.cut)

    @property
    def is_long(self) -> bool:
        """Whether there are slices enough to tell whether the field of view cut the head."""
        return int(self.seen.sum()) >= MIN_SLICES

    @property
    def is_whole(self) -> bool:
        """Whether the stack is known to show the head from end to end; slices between may be missing."""
        return self.is_long and not self.is_cut

    @property
    def n_inside(self) -> int:
        """Number of missing slices between acquired ones."""
        first, last = np.flatnonzero(self.seen)[[0, -1]]
        return int((~self.seen[first : last + 1]).sum())

    @property
    def longest_gap_mm(self) -> float:
        """Length along the normal of the longest gap between acquired slices; 0 without one."""
        steps = np.diff(self.index[self.seen])
        return float((steps.max(initial=1) - 1) * self.spacing_mm) if self.n_inside else 0.0

    @property
    def missing_share(self) -> float:
        """Share of the head in missing slices; too large by up to a half where a stack ends in its largest slice."""
        return float(self.area_mm2[~self.seen].sum() / self.area_mm2.sum())

    @property
    def cut_share(self) -> float | None:
        """Share of the head beyond the field of view, from `MIN_CUT_SHARE` on; else None."""
        share = self.missing_share
        return share if self.is_cut and share >= MIN_CUT_SHARE else None

    @property
    def has_missing(self) -> bool:
        """Whether a part of the head is missing."""
        return self.is_cut or self.n_inside > 0


def area_profiles(slices: Slices) -> list[AreaProfile]:
    """The profile of each stack that has slices, in the order of their numbers."""
    of_stack = [slices.stack_id == stack for stack in np.unique(slices.stack_id)]
    seen = [_profile(slices, one) for one in of_stack]
    whole = [one.volume_mm3 for one in seen if one.is_whole]
    volume_mm3 = float(np.median(whole)) if whole else None
    return [
        _continued(slices, one, profile, volume_mm3) if profile.is_cut else profile
        for one, profile in zip(of_stack, seen, strict=True)
    ]


def head_volume_mm3(slices: Slices) -> float:
    """Median over stacks of masked area times slice spacing (mm^3), missing slices included.

    If any stack is known to show the whole head, only such stacks count; else long ones, if there are any.
    """
    profiles = area_profiles(slices)
    whole = [one for one in profiles if one.is_whole]
    long = [one for one in profiles if one.is_long]
    return float(np.median([one.volume_mm3 for one in whole or long or profiles]))


def _profile(slices: Slices, of_stack: NDArray[np.bool_]) -> AreaProfile:
    """The profile from the first to the last acquired slice of a stack."""
    stack = slices.take(of_stack)
    number, counted = stack.slice_index, _counted(stack)
    plane = stack.pixel_plane[counted]
    count = np.bincount(plane, minlength=len(stack))
    area = count * stack.planes.pixel_area_mm2
    header = stack.planes.with_pose(stack.header_pose)
    point = header.pixel_world_mm(stack.pixel_index[counted])
    sums = np.stack([np.bincount(plane, point[:, axis], minlength=len(stack)) for axis in range(3)], axis=1)
    center = np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None], stack.header_pose.translation_mm)
    spacing = slice_spacing_mm(stack)
    largest = area.max()
    every = np.arange(number[0], number[-1] + 1)
    expected = np.interp(every, number, area)
    kept = np.isin(every, number) | (expected >= MIN_MISSING_AREA * largest)
    every, expected = every[kept], expected[kept]
    cut = (False, False)
    if len(number) >= MIN_SLICES:
        cut = bool(area[0] > MIN_CUT_AREA * largest), bool(area[-1] > MIN_CUT_AREA * largest)
    middle = np.stack([np.interp(every, number, center[:, axis]) for axis in range(3)], axis=1)
    return AreaProfile(
        index=every, area_mm2=expected, center_mm=middle, seen=np.isin(every, number), spacing_mm=spacing, cut=cut
    )


def _counted(stack: Slices) -> NDArray[np.bool_]:
    """Which masked pixels [M] of a stack count as head: all, or the bright ones if many are dark."""
    value = stack.masked_value
    dark = value < DARK_SHARE * np.quantile(value, 0.75)
    return ~dark if dark.mean() > MAX_DARK else np.ones(len(value), np.bool_)


def _continued(
    slices: Slices, of_stack: NDArray[np.bool_], profile: AreaProfile, volume_mm3: float | None
) -> AreaProfile:
    """The profile continued beyond its cut ends; the middle of the area moves on along the normal."""
    before, after = _beyond(profile, _length_of_others_mm(slices, of_stack), volume_mm3)
    first, last = -np.arange(len(before), 0, -1), np.arange(1, len(after) + 1)
    stack = slices.take(of_stack)
    step = stack.header_pose.rotation[0, :, 2] * float(np.median(steps_along_normal_mm(stack)))
    return AreaProfile(
        index=np.concatenate([profile.index[0] + first, profile.index, profile.index[-1] + last]),
        area_mm2=np.concatenate([before[::-1], profile.area_mm2, after]),
        center_mm=np.concatenate(
            [
                profile.center_mm[0] + first[:, None] * step,
                profile.center_mm,
                profile.center_mm[-1] + last[:, None] * step,
            ]
        ),
        seen=np.concatenate([first > 0, profile.seen, last < 0]),
        spacing_mm=profile.spacing_mm,
        cut=profile.cut,
    )


def _length_of_others_mm(slices: Slices, of_stack: NDArray[np.bool_]) -> float | None:
    """Largest extent of other stacks' masks along the normal of a stack, by the headers; None where none shows it."""
    normal = slices.header_pose.rotation[np.flatnonzero(of_stack)[0], :, 2]
    found = []
    for other in np.unique(slices.stack_id[~of_stack]):
        stack = slices.take(slices.stack_id == other)
        if abs(float(stack.header_pose.rotation[0, :, 2] @ normal)) > np.cos(np.deg2rad(MIN_ANGLE_DEG)):
            continue
        plane = stack.pixel_plane
        along = stack.planes.with_pose(stack.header_pose).pixel_world_mm(stack.pixel_index) @ normal
        # slice by slice, so that slices that moved do not add up to a longer head
        low, high = np.full(len(stack), np.inf), np.full(len(stack), -np.inf)
        np.minimum.at(low, plane, along)
        np.maximum.at(high, plane, along)
        found.append(float(np.max(high - low)))
    return max(found) if found else None


def _beyond(
    profile: AreaProfile, length_mm: float | None, volume_mm3: float | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Areas of the slices before the first and after the last one, each from the end outwards.

    They follow the most likely ellipsoid, with area A (1 - ((z - z0) / c)^2), given the areas that were seen, the usual
    length of a head of that area, the length that other stacks show, and the volume of stacks that show the whole head.
    """
    cut, spacing_mm = profile.cut, profile.spacing_mm
    z = (profile.index - profile.index[0]) * spacing_mm
    padded = np.pad(profile.area_mm2, 1, mode="edge")  # smoothed: areas alternate if an interleaved stack moved
    area_mm2 = (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4
    largest = float(area_mm2.max())
    seen_mm = float(z[-1]) + spacing_mm
    half = np.linspace(seen_mm / 2 if all(cut) else seen_mm / 2.2, seen_mm * MAX_LENGTH_GAIN / 2, 60)
    middle = np.linspace(-seen_mm, 2 * seen_mm, 121)
    shape = np.maximum(1 - ((z - middle[:, None, None]) / half[None, :, None]) ** 2, 0.0)
    top = np.minimum((shape @ area_mm2) / np.maximum((shape**2).sum(-1), 1e-9), MAX_AREA_GAIN * largest)
    misfit = area_mm2 - top[..., None] * shape
    cost = 0.5 * ((misfit / (AREA_SPREAD * largest)) ** 2).sum(-1)
    if length_mm is not None:
        cost += 0.5 * (np.log(2 * half / length_mm) / SEEN_LENGTH_SPREAD) ** 2
    if volume_mm3 is not None:
        cost += 0.5 * (np.log(4 / 3 * np.maximum(top, 1e-9) * half / volume_mm3) / WHOLE_VOLUME_SPREAD) ** 2
    usual_mm = LENGTH_RATIO * 2 * np.sqrt(np.maximum(top, 1e-9) / np.pi)
    cost += 0.5 * (np.log(2 * half / usual_mm) / LENGTH_SPREAD) ** 2
    m, h = np.unravel_index(int(cost.argmin()), cost.shape)

    def outwards(start_mm: float, direction: float, end_area: float) -> NDArray[np.float64]:
        steps = np.arange(1, int(np.ceil(2 * half[h] / spacing_mm)) + 1)
        model = top[m, h] * (1 - ((start_mm + direction * steps * spacing_mm - middle[m]) / half[h]) ** 2)
        model = model[: int(np.argmax(model <= 0))] if (model <= 0).any() else model
        # from the area seen at the end to the model's: the difference halves from slice to slice
        at_end = top[m, h] * (1 - ((start_mm - middle[m]) / half[h]) ** 2)
        return np.maximum(model + (end_area - at_end) * 0.5 ** np.arange(1, len(model) + 1), 0.0)

    none = np.zeros(0)
    before = outwards(0.0, -1.0, float(area_mm2[0])) if cut[0] else none
    after = outwards(float(z[-1]), 1.0, float(area_mm2[-1])) if cut[1] else none
    return before, after
