"""How the head moved while each stack was taken: motion segments, order of the slices, movement between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from g3r.geometry import RigidPose
from g3r.registration.motion_segments import SAME_PLACE_MM, changes_in_time, estimate_interleave
from g3r.registration.similarity import StackSamples


def segments_of(
    samples: Sequence[StackSamples], motion: RigidPose, same_mm: float = SAME_PLACE_MM
) -> tuple[list[int], list[int | None]]:
    """Number of motion segments of each stack, and the interleave under which its motions change least.

    Args:
        samples: the thinned pixels of each stack.
        motion: [K] world from header of all slices.
        same_mm: movements between consecutive slices up to this do not start a new segment.
    """
    n_segments, interleave = [], list[int | None]()
    for order, moves_mm in (_in_time(sample, motion) for sample in samples):
        n_segments.append(1 + int((moves_mm > same_mm).sum()))
        interleave.append(order if n_segments[-1] > 1 else None)
    return n_segments, interleave


def median_moves_mm(samples: Sequence[StackSamples], motion: RigidPose) -> list[float]:
    """Median movement of the head from one slice of each stack to the next in time (`head_distance_mm`).

    The order in time is that in which the motions change least, so what no order explains stays large.

    Args:
        samples: the thinned pixels of each stack.
        motion: [K] world from header of all slices.
    """
    moves_mm = [_in_time(sample, motion)[1] for sample in samples]
    return [float(np.median(moves)) if moves.size else 0.0 for moves in moves_mm]


def _in_time(sample: StackSamples, motion: RigidPose) -> tuple[int, NDArray[np.float64]]:
    """The interleave under which the motions of a stack change least, and the movements (mm) in that order."""
    own, center_mm = motion.take(sample.rows), sample.pixels.center_mm
    interleave = estimate_interleave(own, sample.slice_index, center_mm)
    return interleave, changes_in_time(own, sample.slice_index, center_mm, interleave)
