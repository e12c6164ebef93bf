"""Orientations of stacks in the head: mean normals, and how many stacks share one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices

MIN_LENGTH = 0.5
"""Least length of the mean of a stack's unit normals. If it is shorter, the slices have no orientation in common, as
those of a radial scan."""

SAME_DEG = 30.0
"""Angle up to which two stacks have the same orientation; those of three orthogonal ones stay apart under motion."""

SHARED = 0.5
"""Correlation of the errors of masks of parallel stacks: between none, as of a mask that one person spilt, and one, as
of the crown that every mask of an axial stack misses."""


def mean_normals(slices: Slices) -> NDArray[np.float64]:
    """The mean of the unit normals of each stack [n_stacks, 3]; the shorter, the more its slices are turned."""
    normal = slices.planes.rotation[:, :, 2]
    return np.stack([normal[slices.stack_id == stack].mean(0) for stack in np.unique(slices.stack_id)])


def votes_per_stack(slices: Slices) -> NDArray[np.float64]:
    """What the vote of each slice [K] counts: less where its stack shares its orientation with others.

    Masks of parallel stacks have some errors in common, above all that they miss the last slices. n votes with a
    correlation of `SHARED` count as n / (1 + (n - 1) `SHARED`) independent ones, so never as more than two of another
    orientation. A stack without an orientation in common is parallel to none.

    Source: effective sample size of equally correlated measurements (Kish, Survey Sampling, 1965).
    """
    normals = mean_normals(slices)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    cosine = np.abs(normals @ normals.T) / np.maximum(length @ length.T, np.finfo(float).tiny)
    same = (cosine > np.cos(np.deg2rad(SAME_DEG))) & (np.minimum(length, length.T) >= MIN_LENGTH)
    np.fill_diagonal(same, True)
    _, stack = np.unique(slices.stack_id, return_inverse=True)
    return np.asarray(1 / (1 + (same.sum(1) - 1) * SHARED))[stack]
