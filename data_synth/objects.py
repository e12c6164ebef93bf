"""A synthetic object that is not a brain, to test reconstruction without an atlas: asymmetric textured ellipsoids."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data_synth.atlas import TruthVolume
from data_synth.shapes import Coordinates, Field, coverage, ellipsoid, union, wave_field

BODY_MM = (34.0, 44.0, 30.0)
"""Half axes of the body."""
LOBE_MM = (20.0, 18.0, 16.0)
LOBE_OFFSET_MM = (22.0, -26.0, 12.0)
N_INSIDE = 14
"""Number of smaller ellipsoids inside, with other intensities."""
INSIDE_RADIUS_RANGE_MM = (4.0, 12.0)
WAVELENGTHS_MM = (18.0, 9.0)
TEXTURE = 0.12
"""Standard deviation of each texture; the body's intensity is 0.5."""
MARGIN_MM = 4.0


def textured_ellipsoids(spacing_mm: float = 0.8, seed: int = 0) -> TruthVolume:
    """A body with a lobe at its side, filled with smaller ellipsoids and waves.

    Args:
        spacing_mm: isotropic voxel size.
        seed: of the sizes, positions and intensities of the inner structures.
    """
    rng = np.random.default_rng([seed, 0])
    half = np.maximum(BODY_MM, np.abs(LOBE_OFFSET_MM) + LOBE_MM) + MARGIN_MM
    shape = tuple(int(n) for n in 2 * np.ceil(half / spacing_mm).astype(int) + 1)
    affine = np.diag([spacing_mm] * 3 + [1.0])
    affine[:3, 3] = -(np.array(shape) - 1) / 2 * spacing_mm
    axes = [
        np.arange(n, dtype=np.float32) * np.float32(spacing_mm) + np.float32(o)
        for n, o in zip(shape, affine[:3, 3], strict=True)
    ]
    x, y, z = np.meshgrid(*axes, indexing="ij", sparse=True)
    inside = union(ellipsoid((x, y, z), (0, 0, 0), BODY_MM), ellipsoid((x, y, z), LOBE_OFFSET_MM, LOBE_MM), 4.0)
    value = _filled((x, y, z), inside.shape, spacing_mm, rng)
    data, mask = (np.clip(value, 0.05, 1) * coverage(inside, spacing_mm)).astype(np.float32), inside > 0
    data[~mask] = 0
    return TruthVolume(name=f"object {seed}", data=data / np.percentile(data[mask], 99.5), mask=mask, affine=affine)


def _filled(p: Coordinates, shape: tuple[int, ...], spacing_mm: float, rng: np.random.Generator) -> Field:
    """Intensities of the object's interior, on the whole grid."""
    value: NDArray[np.float32] = np.full(shape, 0.5, np.float32)
    for _ in range(N_INSIDE):
        direction = rng.normal(size=3)
        center = direction / np.linalg.norm(direction) * rng.uniform(0, 0.75) * np.array(BODY_MM)
        radius = rng.uniform(*INSIDE_RADIUS_RANGE_MM, size=3)
        share = coverage(ellipsoid(p, tuple(center), tuple(radius)), spacing_mm)
        value += share * (np.float32(rng.uniform(0.1, 1.0)) - value)
    for wavelength in WAVELENGTHS_MM:
        value += np.float32(TEXTURE) * wave_field(p, wavelength, 0.3, 12, rng)
    return value
