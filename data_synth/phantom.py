"""A procedural fetal brain phantom: T2 contrast and labels as functions of gestational age, without any data.

The brain is put together from implicit shapes in a RAS frame centred in the head. What changes with age:
size (biparietal and occipitofrontal diameters of normal fetuses), opening of the Sylvian fissure, number and
depth of sulci, width of the subarachnoid space and of the ventricles, cerebellar width, and contrast.

Sulci are thin radial sheets: the zero set of band-limited noise on the directions from a hemisphere's
centre, from the surface inwards to a depth that grows with age. The cortical plate is the 2 mm
layer under the folded surface, so it lines both banks of every sulcus, as in a real brain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_synth import anatomy
from data_synth.anatomy import Anatomy
from data_synth.shapes import (
    Coordinates,
    Field,
    coverage,
    ellipsoid,
    intersection,
    sheet_distance,
    smooth_noise,
    union,
    wave_field,
)
from g3r.errors import InputError

LABELS = {
    "background": 0,
    "csf": 1,
    "cortical_plate": 2,
    "white_matter": 3,
    "ventricles": 4,
    "cerebellum": 5,
    "deep_grey": 6,
    "brainstem": 7,
}
"""The labels of the FeTA challenge (Payette et al. 2021), so that its tools can read the phantom."""

AGE_RANGE_WEEKS = (18.0, 41.0)


@dataclass(frozen=True)
class Phantom:
    """A synthetic head.

    Args:
        t2: [I, J, K] T2-weighted signal, 0 to about 1000.
        labels: [I, J, K] tissues (`LABELS`).
        mask: [I, J, K] the head, including its fluid.
        affine: [4, 4] RAS+ mm from index.
    """

    t2: NDArray[np.float32]
    labels: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    affine: NDArray[np.float64]


def fetal_brain_phantom(gestational_age_weeks: float = 30.0, spacing_mm: float = 0.8, seed: int = 0) -> Phantom:
    """Procedural T2-weighted fetal brain with labels.

    Args:
        gestational_age_weeks: 18 to 41.
        spacing_mm: isotropic voxel size, 0.3 to 3 mm.
        seed: individual shape, folds and texture; the same seed gives the same voxels.

    Returns:
        The phantom on a RAS grid centred at the origin of the world.

    Raises:
        InputError: age or voxel size out of range.

    Source: head sizes after Kiserud et al. 2017 (WHO fetal growth charts, outer-to-inner diameters rounded);
        contrast and proportions by eye after the published fetal atlases.
    """
    if not AGE_RANGE_WEEKS[0] <= gestational_age_weeks <= AGE_RANGE_WEEKS[1]:
        raise InputError(f"phantom: gestational age of {gestational_age_weeks:g} weeks; expected 18 to 41 weeks")
    if not 0.3 <= spacing_mm <= 3:
        raise InputError(f"phantom: voxel size of {spacing_mm:g} mm; expected 0.3 to 3 mm")
    rng = np.random.default_rng([seed, round(gestational_age_weeks * 100)])
    body = Anatomy.of_age(gestational_age_weeks)
    low = np.array([-body.a - 3, -body.b - 3, -1.22 * body.a - 3])
    high = np.array([body.a + 3, body.b + 3, 0.86 * body.a + 3])
    shape = tuple(int(n) for n in np.ceil((high - low) / spacing_mm).astype(int) + 1)
    affine = np.diag([spacing_mm] * 3 + [1.0])
    affine[:3, 3] = -(np.array(shape) - 1) / 2 * spacing_mm
    middle = (low + high) / 2  # the grid is centred on zero, the shapes on the middle of the cerebrum

    axes = [
        (np.arange(n, dtype=np.float32) * np.float32(spacing_mm) + np.float32(o + s))
        for n, o, s in zip(shape, affine[:3, 3], middle, strict=True)
    ]
    grid = np.meshgrid(*axes, indexing="ij", sparse=True)
    bend = 0.015 * body.a  # individual shape: the coordinates are warped slightly before drawing
    x, y, z = (axis + np.float32(bend) * smooth_noise(shape, 0.45 * body.a, spacing_mm, rng) for axis in grid)
    t2, labels, mask = _draw(body, (x, y, z), spacing_mm, rng)
    return Phantom(t2, labels, mask, affine)


def _draw(
    body: Anatomy, p: Coordinates, spacing_mm: float, rng: np.random.Generator
) -> tuple[Field, NDArray[np.uint8], NDArray[np.bool_]]:
    """Draw the tissues over each other, from CSF inwards, each weighted by its share of the voxel."""
    x, y, z = p
    half = (np.abs(x), y, z)  # mirror-symmetric shapes are drawn for one side
    a, b = body.a, body.b
    cerebrum = _smooth_cerebrum(body, half)
    cerebellum, folia = anatomy.cerebellum(body, half)
    brainstem = anatomy.brainstem(body, half)
    head = union(cerebrum + np.float32(body.csf), union(cerebellum, brainstem, 6) + 2.0, 8.0)
    head = np.minimum(head, ellipsoid(half, (0, 0, -0.03 * a), (a + 0.3, b + 0.3, 1.35 * a)))

    surface = _folded_surface(body, p, cerebrum, spacing_mm, rng)
    ventricles, cavum = anatomy.ventricles(body, half)
    thickness = np.float32(1.9) + 0.25 * smooth_noise(x.shape, 9.0, spacing_mm, rng)
    white = surface - thickness
    deep, caudate = anatomy.deep_grey(body, half)
    callosum = anatomy.corpus_callosum(body, half)

    # White matter: subplate under the cortex, a darker band around the ventricles, slow variation.
    layer = np.exp(-(((white - 2.2) / 2.2) ** 2))
    germinal = np.float32(np.interp(body.weeks, [18, 24, 32, 41], [160, 140, 50, 0]))
    periventricular = np.exp(-(((ventricles + 1.8) / 1.5) ** 2))
    stripe = np.exp(-(((ventricles + 7.5) / 2.0) ** 2)) * np.float32(30)
    wm = body.white + (body.subplate - body.white) * layer - germinal * periventricular - stripe
    wm = wm + 22 * smooth_noise(x.shape, 6.0, spacing_mm, rng)

    soft = max(spacing_mm, 0.6)
    t2 = np.full(x.shape, 1000, np.float32)
    t2 -= 90 * coverage(-(head - 1.5), 3.0)  # the outermost CSF fades into the meninges
    labels = np.ones(x.shape, np.uint8)

    def lay(distance: Field, value: Field | float, name: str, softness_mm: float = soft) -> None:
        share = coverage(distance, softness_mm)
        t2[...] += share * (value - t2)
        labels[share > 0.5] = LABELS[name]

    lay(surface, body.cortex, "cortical_plate")
    lay(white, wm, "white_matter", soft + 0.5)
    lay(intersection(deep, white + 0.5), body.deep, "deep_grey", soft + 1.2)
    lay(caudate, body.deep - 10, "deep_grey", soft + 0.8)
    lay(ventricles, 960.0, "ventricles")
    lay(callosum, body.cortex + 40, "white_matter")
    lay(cavum, 960.0, "ventricles")
    lay(cerebellum, folia, "cerebellum")
    lay(brainstem, body.deep + 20 + 30 * np.cos(x / np.float32(0.05 * a)), "brainstem", soft + 0.4)
    lay(anatomy.fourth_ventricle(body, half), 950.0, "ventricles")

    texture = 1 + 0.012 * smooth_noise(x.shape, 2 * spacing_mm, spacing_mm, rng)
    texture += 0.03 * smooth_noise(x.shape, 18.0, spacing_mm, rng)
    mask = head > 0
    labels[~mask] = 0
    t2 = np.clip(t2 * texture * coverage(head, soft), 0, None).astype(np.float32)
    t2[~mask] = 0
    return t2, labels, mask


def _smooth_cerebrum(body: Anatomy, p: Coordinates) -> Field:
    """Both hemispheres without fissures: an egg (wider behind), flattened below, with temporal lobes."""
    a, b, c = body.a, body.b, body.csf
    x, y, z = p
    taper = 1 - 0.07 * y / np.float32(b)  # narrower forehead
    egg = ellipsoid((x / taper, y, z), (0, 0, 0.02 * a), (a - c, b - c, 0.84 * a - c))
    floor = z + np.float32(0.30 * a) - 0.10 * np.maximum(y, 0) - 0.12 * np.minimum(y + np.float32(0.1 * b), 0)
    upper = intersection(egg, floor, 0.3 * a)
    temporal = ellipsoid(p, (0.50 * a, 0.02 * b, -0.36 * a), (0.31 * a, 0.50 * b, 0.27 * a))
    return union(upper, temporal, 0.12 * a)


def _folded_surface(
    body: Anatomy, p: Coordinates, cerebrum: Field, spacing_mm: float, rng: np.random.Generator
) -> Field:
    """Distance (mm, positive inside) to the brain's surface after fissures and sulci are cut into it."""
    a, b = body.a, body.b
    x, y, z = p
    side = np.abs(x)
    # Interhemispheric fissure down to the corpus callosum, deeper in front and behind than in the middle.
    arch = np.sqrt((y / np.float32(0.50 * b)) ** 2 + ((z + np.float32(0.02 * a)) / np.float32(0.37 * a)) ** 2)
    depth_left = (arch - 1) * np.float32(0.40 * a)
    open_mm = np.float32(0.2 + 0.1 * body.csf)
    surface = intersection(cerebrum, np.sqrt(side**2 + np.minimum(depth_left, 0) ** 2) - open_mm, 0.05 * a)
    # Sylvian fissure: an oblique sheet above the temporal lobe, going in as far as the insula.
    lift = (y - np.float32(0.05 * b)) / np.float32(b)  # the fissure rises towards the back
    slit = z + np.float32(0.16 * a) + np.float32(a) * (0.55 * lift - 0.5 * lift**2)
    insula = np.maximum(np.float32(0.60 * a) - side, 0)
    front = np.maximum(np.abs(y - np.float32(0.08 * b)) - np.float32(0.34 * b), 0)
    outwards = np.clip((side - np.float32(0.6 * a)) / np.float32(0.3 * a), 0, 1)
    wide = np.float32(body.sylvian) * (0.7 + outwards * np.exp(-((y / np.float32(0.25 * b)) ** 2)))
    surface = intersection(surface, np.sqrt((slit * 0.87) ** 2 + insula**2 + front**2) - wide, 3.0)
    if body.depth_primary <= 0.8:
        return surface

    # Sulci: radial sheets on the direction from the hemisphere's centre (sphere of radius a, in mm).
    centre = (np.float32(0.36 * a), np.float32(0), np.float32(0.0))
    sign = np.where(x < 0, np.float32(-1), np.float32(1))
    # Noise on the position curves the sulci; straight radial cuts would look artificial in cross-section.
    wobble = [np.float32(0.035 * a) * smooth_noise(x.shape, 0.14 * a, spacing_mm, rng) for _ in range(3)]
    u = (
        (side - centre[0] + wobble[0]) * 1.25,
        (y - centre[1] + wobble[1]) * np.float32(a / b),
        z - centre[2] + wobble[2],
    )
    length = np.sqrt(u[0] ** 2 + u[1] ** 2 + u[2] ** 2) + np.float32(1.0)
    u = (np.float32(a) * u[0] / length, np.float32(a) * u[1] / length, np.float32(a) * u[2] / length)
    own = (u[0] * sign + np.float32(200) * sign, u[1], u[2])  # the two sides differ in detail
    # No sulci near the centre (all of them meet there), on the base, or into the deep nuclei.
    allowed = np.clip((length - np.float32(0.34 * a)) / np.float32(0.14 * a), 0, 1)
    allowed *= np.clip((z + np.float32(0.42 * a)) / np.float32(0.22 * a), 0.15, 1)
    core = ellipsoid((side, y, z), (0, 0, -0.05 * a), (0.5 * a, 0.5 * b, 0.42 * a))
    allowed *= np.clip(-core / np.float32(0.08 * a), 0, 1)
    for wavelength, depth, weight in ((0.72 * a, body.depth_primary, 0.45), (0.40 * a, body.depth_secondary, 0.6)):
        if depth <= 0.3:
            continue
        noise = wave_field(u, wavelength, 0.25, 14, rng)
        noise += np.float32(weight) * wave_field(own, wavelength, 0.25, 10, rng)
        away = sheet_distance(noise, spacing_mm, 1.1 / wavelength)
        local = np.float32(depth) * np.clip(0.75 + 0.45 * wave_field(u, 1.5 * wavelength, 0.3, 8, rng), 0, 1.3)
        local *= allowed
        below = np.maximum(cerebrum - local, 0)
        valley = np.sqrt(away**2 + below**2) - np.float32((0.25 + 0.1 * body.csf) * min(1, depth / 4)) * allowed
        surface = intersection(surface, valley, 2.5)
    return surface
