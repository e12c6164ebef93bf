"""Open strain: the strain of the head that slices of two orientations do not determine.

Let n and m be the normals of two stacks and E a multiple of n m^T + m n^T. The motion x -> x + a E x of the head keeps
every slice of either stack a rigid plane, to first order: E has no component within a slice, since one of its two
factors is zero there. Slices shift along the other normal and tilt.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.orientations import MIN_LENGTH, mean_normals
from g3r.acquisition.planes import Slices

MAX_CLOSED, MIN_OTHERS = 0.15, 0.5
"""Limits of the singular values of the map from strains to their in-plane parts in the slices of all stacks: the
largest of an open strain, and the smallest of the next strain. The first lets further stacks be 10 degrees from one of
two orientations; the second asks for 45 degrees between the two, since slices of one orientation leave more than one
strain open."""


def crossing_deg(slices: Slices) -> float | None:
    """The largest angle between slices of two stacks, by their mean normals, 0 to 90.

    None for a single stack, and where the slices of a stack have no orientation in common.
    """
    normals = mean_normals(slices)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    if len(normals) < 2 or length.min() < MIN_LENGTH:
        return None
    normals = normals / length
    return float(np.rad2deg(np.arccos(np.clip(np.abs(normals @ normals.T), 0, 1))).max())


def open_strain(normals: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The strain [3, 3] that no stack sees in plane; None where there is not exactly one.

    Args:
        normals: [n_stacks, 3] see `mean_normals`.
    """
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    if length.min() < MIN_LENGTH:
        return None
    normals = normals / length
    units = [np.outer(one, other) for one in np.eye(3) for other in np.eye(3)]
    strains = [unit + unit.T for unit in np.array(units)[[0, 1, 2, 4, 5, 8]]]
    strains = [strain / np.linalg.norm(strain) for strain in strains]
    in_plane = np.eye(3) - normals[:, :, None] * normals[:, None, :]
    seen = np.stack([(in_plane @ strain @ in_plane).ravel() for strain in strains], axis=1)
    _, size, combinations = np.linalg.svd(seen, full_matrices=False)
    if size[-1] > MAX_CLOSED or size[-2] < MIN_OTHERS:
        return None
    return np.einsum("n,nij->ij", combinations[-1], np.stack(strains))


def tilts(normals: NDArray[np.float64], strain: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation vectors [K, 3] with which planes stay rigid in a strained head, per unit of an open strain.

    Args:
        normals: [K, 3] unit normals of the planes.
        strain: [3, 3] see `open_strain`.
    """
    out_of_plane = normals @ strain
    out_of_plane -= normals * (out_of_plane * normals).sum(1, keepdims=True)
    return np.cross(out_of_plane, normals)
