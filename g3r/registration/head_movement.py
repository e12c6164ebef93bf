"""How the head moved while each stack was taken: motion segments, order of the slices, movement between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

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
    for sample in samples:
        own = motion.take(sample.rows)
        order = estimate_interleave(own, sample.slice_index, sample.pixels.center_mm)
        moves = changes_in_time(own, sample.slice_index, sample.pixels.center_mm, order)
        n_segments.append(1 + int((moves > same_mm).sum()))
        interleave.append(order if n_segments[-1] > 1 else None)
    return n_segments, interleave


def median_moves_mm(samples: Sequence[StackSamples], motion: RigidPose) -> list[float]:
    """Median movement of the head from one slice of each stack to the next in time (`head_distance_mm`).

    The order in time is that in which the motions change least, so what no order explains stays large.

    Args:
        samples: the thinned pixels of each stack.
        motion: [K] world from header of all slices.
    """
    found = []
    for sample in samples:
        own = motion.take(sample.rows)
        order = estimate_interleave(own, sample.slice_index, sample.pixels.center_mm)
        moves = changes_in_time(own, sample.slice_index, sample.pixels.center_mm, order)
        found.append(float(np.median(moves)) if moves.size else 0.0)
    return found
