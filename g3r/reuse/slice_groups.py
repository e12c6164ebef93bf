"""Grouping of the slices of a folder into stacks, with their places in them: by `index.tsv`, or by the headers.

Without an index slices are in the order of their numbers. A stack ends where pixel size, thickness or orientation
change, or where the position along the normal starts again. Single slices that moved far away do not begin a stack:
the slices after them decide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.stack_checks import spaced
from g3r.errors import InputError
from g3r.geometry.rigid import orthonormal
from g3r.registration.pose_sampling import angle_deg
from g3r.reuse.slice_files import MAX_SLICE_NUMBER, SliceFile

SAME_LENGTH = 1e-4
"""Largest relative difference of pixel sizes or thickness within a stack: headers keep seven digits."""

SAME_STACK_DEG = 45.0
"""Largest rotation between slices of one stack; the planes of stacks are mostly 90 degrees apart."""

N_LAST = 5
"""Number of last slices of a run that give its present orientation."""

N_COMPARED = 100
"""Number of last slices of a run that give its step and its length so far."""

RESTART_STEPS, RESTART_SHARE = 3.0, 0.5
"""A stack starts again where a slice lies behind the last one by more than this many steps, and by more than this share
of the length so far; motion alone moves slices less."""

HOLE_STEPS, HOLE_TURN_DEG = 2.0, 5.0
"""Slices are missing between consecutive numbers if their distance exceeds a step by at least this many steps, and by
far more than any slice goes backwards, and if they are rotated by less than this angle: motion rotates slices and goes
in both directions. A hole mistaken for motion does no harm, because poses are given; motion mistaken for a hole would
make the head longer."""

REACH = 4
"""Largest distance of slices, in numbers, whose positions give the length of a step before holes are known."""

PASS_THICKNESSES = 1.5
"""Slices with a step of at least this many thicknesses may be one pass of an interleaved stack."""


@dataclass(frozen=True, kw_only=True)
class SliceGroup:
    """Slices of one stack.

    Attributes:
        name: name of the stack.
        files: its slices, in ascending order of their places.
        place: [K] number of each slice in the stack, from 0; numbers may be missing.
    """

    name: str
    files: list[SliceFile]
    place: NDArray[np.int64]

    def __post_init__(self) -> None:
        first = self.files[0]
        for one in self.files[1:]:
            if not _same_lengths(one, first):
                raise InputError(
                    f"{one.path.name}: has pixels and thickness of {spaced(one.spacing_mm)} mm, {first.path.name} of "
                    f"the same stack {spaced(first.spacing_mm)} mm; expected the same, correct index.tsv or remove it"
                )


def grouped_by_index(
    files: Sequence[SliceFile], index: Mapping[int, tuple[int, int]], index_name: str
) -> list[SliceGroup]:
    """Groups according to an index; slices that it names and that have no file were left out.

    Args:
        files: slices of the folder.
        index: stack and slice by number.
        index_name: name of the index file, for messages.

    Raises:
        InputError: the index does not name a slice, or a slice differs from its stack in pixel size or thickness.
    """
    for one in files:
        if one.number not in index:
            raise InputError(
                f"{one.path.name}: {index_name} has no line for it; add its stack and slice, or remove {index_name}"
            )
    found = []
    for stack in sorted({index[one.number][0] for one in files}):
        own = sorted((one for one in files if index[one.number][0] == stack), key=lambda one: index[one.number][1])
        place = np.array([index[one.number][1] for one in own], np.int64)
        found.append(SliceGroup(name=f"stack-{stack}", files=own, place=place))
    return found


def grouped_by_headers(files: Sequence[SliceFile]) -> list[SliceGroup]:
    """Groups by pixel size, thickness, orientation and position; interleaved passes make one stack.

    Args:
        files: slices in the order of their numbers.

    Raises:
        InputError: a stack has too many slices.
    """
    found: list[SliceGroup] = []
    for passes in _stacks_of_passes(_runs(files)):
        own = [one for run in passes for one in run]
        place = _places(passes)
        if place.max() > MAX_SLICE_NUMBER:
            raise InputError(
                f"{own[0].path.name}: begins a stack of {place.max() + 1} slices by the headers; expected at most "
                f"{MAX_SLICE_NUMBER}, add index.tsv with the columns number, stack and slice"
            )
        order = np.argsort(place)
        name = f"stack-{len(found)}"
        found.append(SliceGroup(name=name, files=[own[n] for n in order], place=place[order]))
    return found


def slope(along_mm: NDArray[np.float64], place: NDArray[np.int64], reach: int | None = None) -> float:
    """Median over pairs of slices of their distance divided by the difference of their numbers; 0 for a single slice.

    Args:
        along_mm: [K] positions along the normal.
        place: [K] ascending numbers.
        reach: uses only pairs at most this many slices apart; None uses all.
    """
    first, second = np.triu_indices(len(place), 1)
    if reach is not None:
        near = second - first <= reach
        first, second = first[near], second[near]
    steps = (along_mm[second] - along_mm[first]) / (place[second] - place[first])
    return float(np.median(steps)) if len(steps) else 0.0


def _same_lengths(one: SliceFile, other: SliceFile) -> bool:
    return bool(np.allclose(one.spacing_mm, other.spacing_mm, rtol=SAME_LENGTH, atol=0))


def _frame(files: Sequence[SliceFile]) -> NDArray[np.float64]:
    return orthonormal(np.sum([one.rotation for one in files], axis=0)[None])[0]


def _along_mm(files: Sequence[SliceFile], frame: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array([one.center_mm @ frame[:, 2] for one in files])


def _runs(files: Sequence[SliceFile]) -> list[list[SliceFile]]:
    """Split slices into runs that advance in one direction."""
    runs: list[list[SliceFile]] = [[files[0]]]
    for n, one in enumerate(files[1:], 1):
        run = runs[-1]
        if not _same_lengths(one, run[0]) or (_leaves(run, one) and not _strays(run, one, files[n + 1 : n + 3])):
            runs.append([one])
        else:
            run.append(one)
    return runs


def _strays(run: list[SliceFile], one: SliceFile, next_ones: Sequence[SliceFile]) -> bool:
    """Whether a slice that leaves a run is a stray: the next ones continue the run, or begin one without it."""
    if not any(_leaves(run, other) for other in next_ones):
        return True
    return float(angle_deg(one.rotation, next_ones[0].rotation)) > SAME_STACK_DEG


def _leaves(run: list[SliceFile], one: SliceFile) -> bool:
    """Whether a slice does not continue a run."""
    frame = _frame(run[-N_LAST:])
    if not _same_lengths(one, run[0]) or float(angle_deg(frame, one.rotation)) > SAME_STACK_DEG:
        return True
    if len(run) < 3:
        return False
    along = _along_mm(run[-N_COMPARED:], frame)
    step = slope(along, np.arange(len(along)))
    typical_last = float(np.median(along[-3:])) + step  # a stray at the end must not decide
    back_mm = (typical_last - float(one.center_mm @ frame[:, 2])) * np.sign(step)
    return bool(back_mm > max(RESTART_STEPS * abs(step), RESTART_SHARE * float(np.ptp(along))))


def _stacks_of_passes(runs: list[list[SliceFile]]) -> list[list[list[SliceFile]]]:
    """Join runs that are passes of one interleaved stack."""
    stacks: list[list[list[SliceFile]]] = []
    for run in runs:
        if stacks and _interleaves(stacks[-1], run):
            stacks[-1].append(run)
        else:
            stacks.append([run])
    return stacks


def _interleaves(passes: list[list[SliceFile]], run: list[SliceFile]) -> bool:
    """Whether a run is a further pass of a stack: its slices lie between those of the passes before."""
    n_passes = _n_passes(passes[0])
    if n_passes < 2 or len(passes) >= n_passes or len(run) < 2 or not _same_lengths(run[0], passes[0][0]):
        return False
    if float(angle_deg(_frame(passes[0]), _frame(run))) > SAME_STACK_DEG or abs(len(run) - len(passes[0])) > 1:
        return False
    offset = _offsets([*passes, run], n_passes)
    return len(set((offset % n_passes).tolist())) == len(offset) and int(np.ptp(offset)) < n_passes


def _n_passes(run: list[SliceFile]) -> int:
    """Number of passes that would fill the steps of a run; 1 if the run is a whole stack."""
    step = abs(slope(_along_mm(run, _frame(run)), np.arange(len(run))))
    thickness = float(run[0].spacing_mm[2])
    return int(np.rint(step / thickness)) if step >= PASS_THICKNESSES * thickness else 1


def _offsets(passes: list[list[SliceFile]], n_passes: int) -> NDArray[np.int64]:
    """Beginning of each pass, in steps of the whole stack."""
    frame = _frame([one for run in passes for one in run])
    along = [_along_mm(run, frame) for run in passes]
    step = slope(along[0], np.arange(len(along[0])))
    start = np.array([np.median(one - step * np.arange(len(one))) for one in along])
    return np.asarray(np.rint((start - start[0]) / (step / n_passes)), np.int64)


def _places(passes: list[list[SliceFile]]) -> NDArray[np.int64]:
    """Number, from 0, of each slice in its stack of one or more passes."""
    if len(passes) > 1:
        n_passes = _n_passes(passes[0])
        offset = _offsets(passes, n_passes)
        place = np.concatenate(
            [first + n_passes * np.arange(len(run)) for first, run in zip(offset, passes, strict=True)]
        )
        return place - place.min()
    run = passes[0]
    number = np.array([one.number for one in run], np.int64)
    usual = max(1, int(np.median(np.diff(number)))) if len(run) > 1 else 1
    by_number = np.maximum(np.diff(number, prepend=number[0] - usual) // usual, 1)
    place = np.cumsum(by_number) - 1
    along = _along_mm(run, _frame(run))
    gap = slope(along, place, REACH)
    steps = np.where(by_number > 1, by_number, _steps_by_position(run, along, gap, by_number))
    return np.asarray(np.cumsum(steps) - 1, np.int64)


def _steps_by_position(
    run: list[SliceFile], along_mm: NDArray[np.float64], gap_mm: float, by_number: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Step [K] from the slice before to each slice: above 1 at a hole, which is far longer than jumps by motion.

    Args:
        run: K slices.
        along_mm: [K] positions along the normal.
        gap_mm: length of one step.
        by_number: [K] steps by the numbers of the files.
    """
    steps = np.ones(len(run), np.int64)
    beyond = np.array([_jump(along_mm, n, gap_mm) if n else 1.0 for n in range(len(run))]) - by_number
    backwards = float(np.max(-beyond, initial=0.0))
    for n in np.flatnonzero(beyond >= max(HOLE_STEPS, 3 * backwards)).tolist():
        before, after = _frame(run[max(0, n - 3) : n]), _frame(run[n : n + 3])
        if float(angle_deg(before, after)) < HOLE_TURN_DEG:
            steps[n] = 1 + min(int(np.rint(beyond[n])), MAX_SLICE_NUMBER)
    return steps


def _jump(along_mm: NDArray[np.float64], n: int, gap_mm: float) -> float:
    """Steps from slice n - 1 to slice n, by three slices on either side; at most 1 more than these two are apart."""
    if gap_mm == 0:
        return 1.0
    before, after = along_mm[max(0, n - 3) : n], along_mm[n : n + 3]
    end = np.median(before + gap_mm * np.arange(len(before) - 1, -1, -1))
    start = np.median(after - gap_mm * np.arange(len(after)))
    apart = (along_mm[n] - along_mm[n - 1]) / gap_mm  # the hole may be at a neighbour
    return float(min((start - end) / gap_mm, apart + 1))
