"""Heads bent and recoloured at random: more shapes than an atlas has subjects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import center_of_mass, map_coordinates

from data_synth.atlas import TruthVolume
from g3r.geometry import VolumeGrid

CONTROL_SPACING_MM = 24.0
BEND_MM = 2.5
"""Standard deviation of the displacement of a control point, per axis."""
CURVE_KNOTS = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.5])
CURVE_DEVIATION = 0.08
"""Standard deviation of the intensity at a knot of the curve."""


def varied_head(head: TruthVolume, rng: np.random.Generator) -> TruthVolume:
    """A head in the atlas frame with another shape and other contrasts, still in the atlas frame.

    Shape: smooth displacements from control points 24 mm apart, without their mean; afterwards the mask's
    centroid is put at the origin again. Intensities: a random curve near the identity that keeps zero.
    """
    shape = np.array(head.data.shape)
    spacing_mm = np.linalg.norm(head.affine[:3, :3], axis=0)
    n_control = np.maximum(np.ceil(shape * spacing_mm / CONTROL_SPACING_MM).astype(int) + 1, 2)
    control = torch.from_numpy(rng.normal(0, BEND_MM, (1, 3, *n_control)))
    field_mm = torch.nn.functional.interpolate(
        control, size=tuple(head.data.shape), mode="trilinear", align_corners=True
    )[0].numpy()
    field_mm -= field_mm[:, head.mask].mean(1)[:, None, None, None]
    index = np.indices(head.data.shape) + field_mm / spacing_mm[:, None, None, None]
    data = map_coordinates(head.data, index, order=1, output=np.float32)
    mask = map_coordinates(head.mask.astype(np.float32), index, order=1) > 0.5

    offset = rng.normal(0, CURVE_DEVIATION, len(CURVE_KNOTS))
    curve = np.maximum(CURVE_KNOTS + offset * (CURVE_KNOTS > 0), 0)
    data = np.interp(data, CURVE_KNOTS, curve).astype(np.float32)
    affine = head.affine.copy()
    affine[:3, 3] -= VolumeGrid(head.data.shape, affine).world(center_of_mass(mask))
    return replace(head, data=np.where(mask, data, np.float32(0)), mask=mask, affine=affine)
