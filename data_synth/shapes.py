"""Implicit shapes that make up the phantom: signed distances in millimetres, positive inside.

Coordinates are three separate arrays that broadcast; results have the broadcast shape. The distances are exact near a
surface. Far from it only their order is right, which is enough for partial-volume weights (`coverage`) and for layers
a few millimetres thick.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

Field = NDArray[Any]  # float32; numpy's stubs lose the width in mixed expressions
Coordinates = tuple[Field, Field, Field]


def ellipsoid(p: Coordinates, center_mm: tuple[float, ...], radius_mm: tuple[float, ...]) -> Field:
    """Signed distance (mm) to an axis-aligned ellipsoid, first order in the distance from its surface.

    Args:
        p: coordinates (mm).
        center_mm: [3].
        radius_mm: [3] half axes.
    """
    q = [(axis - np.float32(c)) / np.float32(r) for axis, c, r in zip(p, center_mm, radius_mm, strict=True)]
    k0 = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
    k1 = np.sqrt(sum((axis / np.float32(r)) ** 2 for axis, r in zip(q, radius_mm, strict=True)))
    depth = k0 / np.maximum(k1, np.float32(1e-6))  # 0 / 0 at the centre, where the smallest radius is used instead
    return (1 - k0) * np.where(k0 < 1e-6, np.float32(min(radius_mm)), depth)


def tube(p: Coordinates, points_mm: list[tuple[float, ...]], radius_mm: list[float]) -> Field:
    """Signed distance (mm) to a tube along a polyline whose radius changes linearly between its points.

    Args:
        p: coordinates (mm).
        points_mm: [n, 3] of the polyline.
        radius_mm: [n] at its points.
    """
    best: Field | None = None
    for a, b, ra, rb in zip(points_mm, points_mm[1:], radius_mm, radius_mm[1:], strict=False):
        axis = np.subtract(b, a)
        along = sum((x - np.float32(o)) * np.float32(d) for x, o, d in zip(p, a, axis, strict=True))
        t = np.clip(along / np.float32(axis @ axis), 0, 1)
        gap = np.sqrt(sum((x - np.float32(o) - t * np.float32(d)) ** 2 for x, o, d in zip(p, a, axis, strict=True)))
        inside = np.float32(ra) + t * np.float32(rb - ra) - gap
        best = inside if best is None else union(best, inside, 0.5 * max(ra, rb))
    assert best is not None
    return best


def union(a: Field, b: Field, blend_mm: float = 0.0) -> Field:
    """Union of two shapes (polynomial smooth maximum).

    Args:
        a: signed distance (mm).
        b: signed distance (mm).
        blend_mm: width over which the concave edges between the shapes are filled.
    """
    if blend_mm <= 0:
        return np.maximum(a, b)
    h = np.maximum(np.float32(blend_mm) - np.abs(a - b), 0)
    return np.maximum(a, b) + h * h * np.float32(0.25 / blend_mm)


def intersection(a: Field, b: Field, blend_mm: float = 0.0) -> Field:
    """Intersection of two shapes, with rounded edges.

    Args:
        a: signed distance (mm), positive inside.
        b: signed distance (mm), positive inside.
        blend_mm: width over which the convex edges between the shapes are rounded.
    """
    return -union(-a, -b, blend_mm)


def sheet_distance(field: Field, spacing_mm: float, floor_per_mm: float) -> Field:
    """Distance (mm) to the zero surface of a smooth field: |f| / |grad f|, exact close to the surface.

    Args:
        field: smooth scalar field on a voxel grid.
        spacing_mm: voxel size.
        floor_per_mm: lower bound of the gradient (1/mm), so that saddle points cause no wide openings.
    """
    slope = sum(np.gradient(field, np.float32(spacing_mm), axis=axis) ** 2 for axis in range(3))
    return np.abs(field) / np.sqrt(slope + np.float32(floor_per_mm) ** 2)


def coverage(distance_mm: Field, softness_mm: float) -> Field:
    """Fraction of a voxel inside a shape: a linear ramp of width `softness_mm` across its surface."""
    return np.clip(np.float32(0.5) + distance_mm / np.float32(softness_mm), 0, 1)


def wave_field(p: Coordinates, wavelength_mm: float, bandwidth: float, n_waves: int, rng: np.random.Generator) -> Field:
    """Band-limited noise of unit variance: a sum of cosines with random directions and phases.

    Args:
        p: coordinates (mm).
        wavelength_mm: central wavelength.
        bandwidth: relative spread of the wave numbers, e.g. 0.2.
        n_waves: number of cosines.
        rng: source of directions, wave numbers and phases.
    """
    direction = rng.normal(size=(n_waves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    number = 2 * np.pi / wavelength_mm * (1 + bandwidth * rng.uniform(-1, 1, n_waves))
    phase = rng.uniform(0, 2 * np.pi, n_waves)
    out = np.zeros(np.broadcast_shapes(*(axis.shape for axis in p)), np.float32)
    for d, k, f in zip(direction, number, phase, strict=True):
        kx, ky, kz = (np.float32(k * v) for v in d)
        out += np.cos(kx * p[0] + ky * p[1] + kz * p[2] + np.float32(f))
    return out * np.float32(np.sqrt(2 / n_waves))


def smooth_noise(shape: tuple[int, ...], sigma_mm: float, spacing_mm: float, rng: np.random.Generator) -> Field:
    """Gaussian noise of unit variance with a correlation length of about `sigma_mm`, on a voxel grid.

    The noise is drawn on a coarse grid with the correlation length as its spacing and interpolated by cubic splines.
    A long correlation therefore costs no more than a short one.

    Args:
        shape: of the grid.
        sigma_mm: correlation length.
        spacing_mm: voxel size.
        rng: source of randomness.
    """
    step = max(1.0, sigma_mm / spacing_mm)
    small = tuple(int(np.ceil(n / step)) + 3 for n in shape)
    lattice = gaussian_filter(rng.normal(size=small), 1.0, mode="wrap")
    lattice /= lattice.std()
    coefficient = spline_filter(lattice, 3)
    index = np.meshgrid(*(np.arange(n, dtype=np.float32) / step + 1 for n in shape), indexing="ij", sparse=False)
    return map_coordinates(coefficient, index, order=3, prefilter=False, output=np.float32)
