"""Simulated pathology that atlases of healthy subjects lack: enlarged ventricles, and lesions of any intensity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from data_synth.atlas import TruthVolume
from g3r.geometry import VolumeGrid

Array = NDArray[np.float64]

REACH_MM = 4.0
"""Distance from the wall of a ventricle within which tissue is displaced."""

LESION_RADIUS_MM = (1.5, 6.0)
LESION_EDGE_MM = 0.4
MAX_LESIONS = 3


def enlarged_ventricles(head: TruthVolume, translation_mm: float) -> TruthVolume:
    """A head with enlarged ventricles that displace the brain around them.

    Args:
        head: with ventricles; a head without is returned unchanged.
        translation_mm: largest movement of the walls; up to `REACH_MM` no tissue is folded.

    Raises:
        ValueError: a translation below 0 or beyond `REACH_MM`.
    """
    if not 0 <= translation_mm <= REACH_MM:
        raise ValueError(f"walls move by {translation_mm:g} mm; expected 0 to {REACH_MM:g} mm")
    if head.ventricles is None or not head.ventricles.any():
        return head
    spacing_mm = np.linalg.norm(head.affine[:3, :3], axis=0)
    smooth = gaussian_filter(head.ventricles.astype(np.float32), REACH_MM / spacing_mm, truncate=3.0)
    inwards = np.stack(np.gradient(smooth, *spacing_mm))  # 1/mm, along the grid's axes
    steepest = float(np.sqrt((inwards**2).sum(0)).max())
    # each voxel takes its value from a point further inwards
    index = np.indices(head.data.shape, dtype=np.float32)
    index += inwards * np.float32(translation_mm / steepest) / spacing_mm[:, None, None, None].astype(np.float32)
    data = map_coordinates(head.data, index, order=3, mode="nearest", output=np.float32)
    ventricles = map_coordinates(head.ventricles.astype(np.float32), index, order=1) > 0.5
    labels = head.labels
    if labels is not None:
        labels = map_coordinates(labels, index, order=0, mode="nearest")
    data = np.where(head.mask, np.clip(data, 0, None), 0).astype(np.float32)
    return replace(head, data=data, ventricles=ventricles, labels=labels)


def with_lesions(head: TruthVolume, rng: np.random.Generator) -> TruthVolume:
    """A head with one to three random ellipsoidal lesions centred anywhere in the mask."""
    inside = np.argwhere(head.mask)
    for _ in range(int(rng.integers(1, MAX_LESIONS + 1))):
        center = inside[rng.integers(len(inside))]
        radii = rng.uniform(*LESION_RADIUS_MM) * np.exp(rng.normal(0, 0.25, 3))
        axes = Rotation.random(rng=rng).as_matrix()
        head = with_lesion(head, center, radii, float(rng.uniform(0.0, 1.2)), axes)
    return head


def with_lesion(
    head: TruthVolume, center: NDArray[np.integer], radii_mm: Array, intensity: float, axes: Array | None = None
) -> TruthVolume:
    """A head with one ellipsoidal lesion of uniform intensity.

    Args:
        head: intensities of order one.
        center: [3] voxel.
        radii_mm: [3] half axes.
        intensity: of the lesion.
        axes: [3, 3] axes of the ellipsoid as columns; None takes the axes of the world.
    """
    grid = VolumeGrid(head.data.shape, head.affine)
    box = _box(head, center, float(np.max(radii_mm)) + 4 * LESION_EDGE_MM)
    index = np.stack(np.meshgrid(*[np.arange(s.start, s.stop) for s in box], indexing="ij"), -1)
    away = grid.world(index.reshape(-1, 3)) - grid.world(np.asarray(center, float))
    local = away @ (np.eye(3) if axes is None else axes)
    # the distance to the surface, exact for a sphere
    outside_mm = (np.linalg.norm(local / radii_mm, axis=1) - 1) * float(np.mean(radii_mm))
    share = 1 / (1 + np.exp(np.clip(outside_mm / (LESION_EDGE_MM / 2), -50, 50)))
    share = share.reshape(index.shape[:3]) * head.mask[box]
    data = head.data.copy()
    data[box] += (share * (intensity - data[box])).astype(np.float32)
    return replace(head, data=data)


def _box(head: TruthVolume, center: NDArray[np.integer], reach_mm: float) -> tuple[slice, ...]:
    reach = np.ceil(reach_mm / np.linalg.norm(head.affine[:3, :3], axis=0)).astype(int)
    low = np.maximum(np.asarray(center) - reach, 0)
    high = np.minimum(np.asarray(center) + reach + 1, head.data.shape)
    return tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
