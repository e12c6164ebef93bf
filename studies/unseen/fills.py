"""Fills of the unseen part, for comparison: none, harmonic, template, V_prior and the volume."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.linalg import cg

from g3r.fitting.initial_volumes import InitialVolumes
from g3r.fitting.prior_volume import placed_template, prior_volume
from g3r.prior.maps import Tiling
from g3r.prior.model import Prior
from g3r.registration import Registration

FILLS = ("nothing", "harmonic", "template", "V_prior", "volume")
"""Fills in the order of the table; the last is the written volume of the product."""


def harmonic(values: NDArray[np.float32], unknown: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The volume with its unknown voxels filled by Laplace's equation from the known voxels around them.

    Args:
        values: [I, J, K].
        unknown: [I, J, K] voxels to fill; none may touch the border of the volume.
    """
    if not unknown.any():
        return values.copy()
    number = np.full(values.shape, -1)
    number[unknown] = np.arange(unknown.sum())
    index = np.argwhere(unknown)
    rows, columns, right = [], [], np.zeros(len(index))
    for step in np.concatenate([np.eye(3, dtype=int), -np.eye(3, dtype=int)]):
        neighbour = tuple((index + step).T)
        inside = number[neighbour] >= 0
        rows.append(np.flatnonzero(inside))
        columns.append(number[neighbour][inside])
        right[~inside] += values[neighbour][~inside]
    row, column = np.concatenate(rows), np.concatenate(columns)
    links = coo_array((-np.ones(len(row)), (row, column)), shape=(len(index), len(index)))
    diagonal = coo_array((np.full(len(index), 6.0), (np.arange(len(index)), np.arange(len(index)))))
    solved, _ = cg(csr_array(links + diagonal), right, rtol=1e-4, maxiter=2000)
    result = values.copy()
    result[unknown] = solved
    return result


def filled_volumes(
    poses: Registration, prior: Prior, voxel_mm: float
) -> tuple[dict[str, NDArray[np.float32]], InitialVolumes]:
    """The volume of the slices alone with each fill but the last two, and the initial volumes it was made from.

    Args:
        poses: of the slices.
        prior: whose template is fitted.
        voxel_mm: of the volumes.
    """
    placed = placed_template(prior, poses.orientation)
    box_mm = placed.box_mm() if placed else None
    volumes = InitialVolumes.of(poses.slices, poses.gain, poses.weight, voxel_mm, box_mm)
    whole = prior_volume(volumes, poses.gain, poses.weight, None, placed, n_views=1, tiling=Tiling())
    unknown = volumes.foreground.out_of_reach.copy()
    for axis in range(3):
        edges = [slice(None)] * 3
        edges[axis] = slice(0, None, unknown.shape[axis] - 1)
        unknown[tuple(edges)] = False
    out_of_reach = volumes.foreground.out_of_reach
    found = {
        "nothing": np.where(out_of_reach, 0, volumes.sharp),
        "harmonic": harmonic(np.where(out_of_reach, 0, volumes.sharp), unknown),
        "template": np.where(out_of_reach, whole.values, volumes.sharp),
    }
    return {name: one.astype(np.float32) for name, one in found.items()}, volumes
