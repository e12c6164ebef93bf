"""Anatomy of the phantom: sizes and signals by gestational age, and the structures of the brain as shapes.

Structures are signed distances in mm, positive inside (`data_synth.shapes`). They are symmetric about x = 0
and are drawn for x >= 0 only.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from data_synth.shapes import Coordinates, Field, ellipsoid, intersection, tube, union

# Columns: weeks, biparietal and occipitofrontal diameter (mm; outer border of the subarachnoid space),
# subarachnoid space (mm), half opening of the Sylvian fissure (mm), depth of the primary and of the
# secondary sulci (mm), T2 signal of cortical plate, white matter, subplate, deep grey (CSF is 1000).
_GROWTH = np.array(
    [
        # GA   BPD   OFD  SAS  Sylv  d1   d2    CP   WM   SP   DG
        [18.0, 43.0, 53.0, 2.6, 2.4, 0.0, 0.0, 430, 600, 720, 470],
        [21.0, 52.0, 65.0, 2.8, 2.4, 0.0, 0.0, 430, 610, 720, 470],
        [25.0, 63.0, 79.0, 2.8, 1.9, 2.0, 0.0, 430, 620, 710, 480],
        [30.0, 75.0, 95.0, 2.6, 1.1, 8.0, 1.0, 430, 630, 690, 490],
        [34.0, 85.0, 107.0, 2.1, 0.7, 11.0, 4.5, 400, 600, 630, 450],
        [37.0, 92.0, 115.0, 1.8, 0.5, 13.0, 7.0, 370, 550, 570, 420],
        [41.0, 97.0, 121.0, 1.5, 0.4, 14.0, 8.5, 360, 520, 530, 400],
    ]
)


@dataclass(frozen=True, kw_only=True)
class Anatomy:
    """Sizes (mm) and T2 signals at one age.

    Args:
        weeks: gestational age.
        a: half the biparietal diameter.
        b: half the occipitofrontal diameter.
        csf: width of the subarachnoid space.
        sylvian: half opening of the Sylvian fissure.
        depth_primary: depth of the primary sulci.
        depth_secondary: depth of the secondary sulci.
        cortex: signal of the cortical plate.
        white: signal of the white matter.
        subplate: signal of the subplate.
        deep: signal of the deep grey matter.
    """

    weeks: float
    a: float
    b: float
    csf: float
    sylvian: float
    depth_primary: float
    depth_secondary: float
    cortex: float
    white: float
    subplate: float
    deep: float

    @classmethod
    def of_age(cls, weeks: float) -> Anatomy:
        """Interpolate the growth table at an age."""
        names = [field.name for field in fields(cls)]
        row = dict(zip(names, (float(np.interp(weeks, _GROWTH[:, 0], column)) for column in _GROWTH.T), strict=True))
        return cls(**{**row, "a": row["a"] / 2, "b": row["b"] / 2})


def ventricles(body: Anatomy, p: Coordinates) -> tuple[Field, Field]:
    """Lateral ventricles; third ventricle together with the cavum septi pellucidi."""
    a, b = body.a, body.b
    scale = float(np.interp(body.weeks, [18, 22, 30, 41], [4.2, 4.4, 3.9, 3.0]))
    x, y, z = p
    lateral = tube(
        (x * 1.15, y, z),  # a little flatter sideways than up and down
        [
            (0.17 * a, 0.40 * b, 0.08 * a),
            (0.17 * a, 0.05 * b, 0.21 * a),
            (0.27 * a, -0.26 * b, 0.17 * a),
            (0.42 * a, -0.40 * b, 0.02 * a),
            (0.34 * a, -0.62 * b, -0.02 * a),
        ],
        [0.55 * scale, 0.60 * scale, 0.80 * scale, 1.05 * scale, 0.45 * scale],
    )
    horn = tube(
        p,
        [(0.44 * a, -0.38 * b, -0.02 * a), (0.53 * a, -0.15 * b, -0.30 * a), (0.50 * a, 0.08 * b, -0.38 * a)],
        [0.80 * scale, 0.45 * scale, 0.25 * scale],
    )
    lateral = union(lateral, horn, 2.0)
    third = ellipsoid(p, (0, 0.02 * b, -0.10 * a), (1.3, 0.20 * b, 0.20 * a))
    cavum = ellipsoid(p, (0, 0.24 * b, 0.13 * a), (0.75 * scale, 0.16 * b, 0.09 * a))
    return lateral, union(third, cavum, 1.0)


def corpus_callosum(body: Anatomy, p: Coordinates) -> Field:
    """A thin arch over the ventricles, seen in the midline and fanning out a little to the sides."""
    a, b = body.a, body.b
    x, y, z = p
    radius = np.sqrt((y - np.float32(0.04 * b)) ** 2 * np.float32((0.32 * a / (0.42 * b)) ** 2) + z**2)
    arch = np.float32(1.0 + 0.03 * a) - np.abs(radius - np.float32(0.30 * a) - 0.45 * x)
    arch = intersection(arch, z - 0.02 * a, 1.0)
    return intersection(arch, np.float32(0.15 * a) - x, 2.0)


def deep_grey(body: Anatomy, p: Coordinates) -> tuple[Field, Field]:
    """Thalami and lentiform nuclei; caudate heads with the ganglionic eminence along the ventricle."""
    a, b = body.a, body.b
    thalamus = ellipsoid(p, (0.17 * a, -0.08 * b, -0.04 * a), (0.155 * a, 0.19 * b, 0.16 * a))
    lentiform = ellipsoid(p, (0.37 * a, 0.12 * b, -0.05 * a), (0.12 * a, 0.25 * b, 0.17 * a))
    caudate = tube(
        p,
        [(0.26 * a, 0.32 * b, 0.02 * a), (0.28 * a, 0.05 * b, 0.14 * a), (0.36 * a, -0.18 * b, 0.12 * a)],
        [0.085 * a, 0.05 * a, 0.03 * a],
    )
    return union(thalamus, lentiform, 1.0), caudate


def cerebellum(body: Anatomy, p: Coordinates) -> tuple[Field, Field]:
    """Cerebellar hemispheres with vermis, and their signal: folia around a brighter centre."""
    a, b = body.a, body.b
    half_width = 0.53 * body.weeks  # transcerebellar diameter in mm is about the age in weeks
    size = half_width / 20.0
    centre = (0.44 * half_width, -0.50 * b, -0.58 * a)
    lobe = ellipsoid(p, centre, (0.58 * half_width, 13.0 * size, 11.0 * size))
    vermis = ellipsoid(p, (0, -0.48 * b, -0.57 * a), (4.5 * size, 11.5 * size, 12.0 * size))
    whole = union(lobe, vermis, 3.0)
    x, y, z = p
    # Folia are lamellae fanned around the peduncle, in front of the cerebellum.
    angle = np.arctan2(z - np.float32(centre[2]), -(y - np.float32(centre[1] + 11 * size)))
    number = np.float32(np.interp(body.weeks, [18, 24, 30, 41], [10, 14, 22, 32]))
    strength = np.float32(np.interp(body.weeks, [18, 24, 30, 41], [20, 50, 110, 170]))
    lamella = np.cos(number * angle + 0.15 * x)
    depth = np.clip(whole / np.float32(5.0 * size), 0, 1)  # 0 at the surface, 1 in the white centre
    signal = np.float32(body.cortex + 40) + 130 * depth + strength * lamella * (1 - depth) * 0.6
    return whole - 0.5 * np.maximum(lamella, 0) * np.float32(min(1.0, float(strength) / 120)), signal


def brainstem(body: Anatomy, p: Coordinates) -> Field:
    """Midbrain, pons (bulging forwards) and medulla."""
    a, b = body.a, body.b
    stem = tube(
        p,
        [(0, -0.06 * b, -0.20 * a), (0, -0.13 * b, -0.48 * a), (0, -0.22 * b, -0.85 * a), (0, -0.28 * b, -1.05 * a)],
        [0.17 * a, 0.15 * a, 0.11 * a, 0.08 * a],
    )
    pons = ellipsoid(p, (0, -0.10 * b, -0.54 * a), (0.20 * a, 0.13 * b, 0.17 * a))
    return union(stem, pons, 2.0)


def fourth_ventricle(body: Anatomy, p: Coordinates) -> Field:
    """The fluid between pons and vermis."""
    a, b = body.a, body.b
    return ellipsoid(p, (0, -0.27 * b, -0.56 * a), (0.09 * a, 0.04 * b, 0.14 * a))
