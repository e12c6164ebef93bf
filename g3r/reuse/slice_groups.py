"""Which slices of a folder are of one stack, and their places in it: by `index.tsv`, or by what the headers say.

Without an index the numbers tell the order. A stack ends where pixel size, thickness or orientation become others, or
where the position along the normal starts again. Single slices that moved far away are no new stack: the slices after
them decide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.stacks import spaced
from g3r.errors import InputError
from g3r.geometry.rigid import orthonormal
from g3r.registration.pose_sampling import angle_deg
from g3r.reuse.slice_files import MAX_SLICE_NUMBER, SliceFile

SAME_LENGTH = 1e-4
"""Relative difference of pixel sizes or thickness up to which they are one: headers keep seven digits."""

SAME_STACK_DEG = 45.0
"""Slices of one stack are turned against each other by less; the planes of stacks are mostly 90 degrees apart."""

N_LAST = 5
"""Slices at the end of a stack that say how it is oriented and where it has come to."""

N_COMPARED = 100
"""Slices that say how long a stack is so far."""

RESTART_STEPS, RESTART_SHARE = 3.0, 0.5
"""A stack starts again where a slice lies behind the last one by more than this many steps, and by more than this share
of the length so far; motion alone moves slices by less."""

HOLE_STEPS, HOLE_TURN_DEG = 2.0, 5.0
"""Between slices of consecutive numbers, others are missing where these are further apart by so many steps, by far more
than any go backwards, and turned by less than this: motion turns slices and goes both ways. A hole that is taken for
motion does no harm, since poses are given; motion that is taken for a hole would make the head longer."""

REACH = 4
"""Slices so near to each other say how long a step is, before holes are known."""

PASS_THICKNESSES = 1.5
"""Slices whose steps are at least so many thicknesses may be one pass of an interleaved stack."""


@dataclass(frozen=True, kw_only=True)
class SliceGroup:
    """Slices of one stack.

    Attributes:
        name: of the stack.
        files: in ascending order of their places.
        place: [K] number of each in the stack, from 0; not every number need be there.
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
    """Groups as an index says; slices that it names and that are not there were left out.

    Args:
        files: of the folder.
        index: stack and slice by number.
        index_name: of its file, for messages.

    Raises:
        InputError: a slice that the index does not name, or one of other pixels than its stack.
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
        files: in the order of their numbers.

    Raises:
        InputError: a stack of too many slices.
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
    """Median over pairs of the distance over the difference of their numbers; 0 for a single one.

    Args:
        along_mm: [K].
        place: [K] ascending numbers.
        reach: only pairs that are at most so many slices apart; all when None.
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
    """Slices that follow each other in one direction."""
    runs: list[list[SliceFile]] = [[files[0]]]
    for n, one in enumerate(files[1:], 1):
        run = runs[-1]
        if not _same_lengths(one, run[0]) or (_leaves(run, one) and not _strays(run, one, files[n + 1 : n + 3])):
            runs.append([one])
        else:
            run.append(one)
    return runs


def _strays(run: list[SliceFile], one: SliceFile, next_ones: Sequence[SliceFile]) -> bool:
    """Whether a slice that leaves a run is alone: the next ones go on with the run, or begin one without it."""
    if not any(_leaves(run, other) for other in next_ones):
        return True
    return float(angle_deg(one.rotation, next_ones[0].rotation)) > SAME_STACK_DEG


def _leaves(run: list[SliceFile], one: SliceFile) -> bool:
    """Whether a slice does not go on where a run has come to."""
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
    """Runs that belong together as passes of an interleaved stack."""
    stacks: list[list[list[SliceFile]]] = []
    for run in runs:
        if stacks and _interleaves(stacks[-1], run):
            stacks[-1].append(run)
        else:
            stacks.append([run])
    return stacks


def _interleaves(passes: list[list[SliceFile]], run: list[SliceFile]) -> bool:
    """Whether a run lies between the slices of the passes before."""
    n_passes = _n_passes(passes[0])
    if n_passes < 2 or len(passes) >= n_passes or len(run) < 2 or not _same_lengths(run[0], passes[0][0]):
        return False
    if float(angle_deg(_frame(passes[0]), _frame(run))) > SAME_STACK_DEG or abs(len(run) - len(passes[0])) > 1:
        return False
    offset = _offsets([*passes, run], n_passes)
    return len(set((offset % n_passes).tolist())) == len(offset) and int(np.ptp(offset)) < n_passes


def _n_passes(run: list[SliceFile]) -> int:
    """Passes that would fill the steps of a run; 1 where the run is a whole stack."""
    step = abs(slope(_along_mm(run, _frame(run)), np.arange(len(run))))
    thickness = float(run[0].spacing_mm[2])
    return int(np.rint(step / thickness)) if step >= PASS_THICKNESSES * thickness else 1


def _offsets(passes: list[list[SliceFile]], n_passes: int) -> NDArray[np.int64]:
    """Where each pass begins, in steps of the whole stack."""
    frame = _frame([one for run in passes for one in run])
    along = [_along_mm(run, frame) for run in passes]
    step = slope(along[0], np.arange(len(along[0])))
    start = np.array([np.median(one - step * np.arange(len(one))) for one in along])
    return np.asarray(np.rint((start - start[0]) / (step / n_passes)), np.int64)


def _places(passes: list[list[SliceFile]]) -> NDArray[np.int64]:
    """Number in the stack, from 0, of each slice of its passes."""
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
    """Step [K] to each slice from the one before: above 1 where a hole is far longer than motion makes jumps.

    Args:
        run: of K slices.
        along_mm: [K] along the normal.
        gap_mm: of one step.
        by_number: [K] steps as the numbers have them.
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
    """Steps from slice n - 1 to slice n, by three slices on either side; hardly more than these two are apart."""
    if gap_mm == 0:
        return 1.0
    before, after = along_mm[max(0, n - 3) : n], along_mm[n : n + 3]
    end = np.median(before + gap_mm * np.arange(len(before) - 1, -1, -1))
    start = np.median(after - gap_mm * np.arange(len(after)))
    apart = (along_mm[n] - along_mm[n - 1]) / gap_mm  # the hole may be at a neighbour
    return float(min((start - end) / gap_mm, apart + 1))
