"""Random elastic deformation and contrast of heads, for more variety than the subjects of an atlas have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torchio as tio
from scipy.ndimage import center_of_mass

from data_synth.atlas import TruthVolume
from data_synth.augment import transformed
from g3r.geometry import VolumeGrid

CONTROL_SPACING_MM = 24.0
MAX_BEND_MM = 7.0
"""Largest displacement of a control point per axis; B-splines reduce it to a third between the points."""
SPLINE_ORDER = 3
CURVE_KNOTS = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.5])
CURVE_DEVIATION = 0.08
"""Standard deviation of the intensity at a knot of the curve."""


def varied_head(head: TruthVolume, rng: np.random.Generator) -> TruthVolume:
    """A head in the atlas frame with a random shape and contrast; the result is in the atlas frame too."""
    return recurved(bent(head, rng), rng)


def bent(head: TruthVolume, rng: np.random.Generator) -> TruthVolume:
    """A head deformed elastically by control points 24 mm apart, with the mask's centroid back at the origin."""
    extent_mm = np.array(head.data.shape) * np.linalg.norm(head.affine[:3, :3], axis=0)
    n_control = np.ceil(extent_mm / CONTROL_SPACING_MM).astype(int) + SPLINE_ORDER
    transform = tio.RandomElasticDeformation(
        num_control_points=tuple(n_control.tolist()), max_displacement=MAX_BEND_MM, locked_borders=0
    )
    moved = transformed(head, transform, rng)
    affine = moved.affine.copy()
    affine[:3, 3] -= VolumeGrid(moved.data.shape, affine).world(center_of_mass(moved.mask))
    return replace(moved, affine=affine)


def recurved(head: TruthVolume, rng: np.random.Generator) -> TruthVolume:
    """A head whose intensities are mapped by a random curve near the identity that keeps zero.

    The knots are at fixed fractions of the head's brightness (its 99.5th percentile is 1). MONAI's
    `RandHistogramShift` spreads its knots between the extremes of each image, so single bright voxels would shift them.
    """
    offset = rng.normal(0, CURVE_DEVIATION, len(CURVE_KNOTS))
    curve = np.maximum(CURVE_KNOTS + offset * (CURVE_KNOTS > 0), 0)
    return replace(head, data=np.interp(head.data, CURVE_KNOTS, curve).astype(np.float32))
