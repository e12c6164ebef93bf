"""Head of a scene: an atlas brain with outer fluid, skull, scalp, face and neck, as labels on a fine grid."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, distance_transform_edt, gaussian_filter, label

from data_synth.atlas import TruthVolume
from data_synth.mask_labels import Tissue
from data_synth.noise import lattice_noise
from data_synth.shapes import Coordinates, Field, ellipsoid, tube

CLOSING_MM = 9.0
"""Clefts of an atlas mask narrower than twice this are filled, since they lie inside the skull: fissures, and the fluid
under the brain."""
SMOOTHING_MM = 1.5
"""Smoothing of the skull's inner surface, which is smoother than an atlas mask."""
FLUID_INTENSITY = 0.95
AROUND_MM = 16.0
"""Margin of the grid for skull, scalp and adjacent tissue."""
BELOW_MM = 34.0
"""Margin of the grid for the face in front and the neck below."""


@dataclass(frozen=True, kw_only=True)
class SceneHead:
    """A head ready to be imaged with any contrast.

    Args:
        brain: [I, J, K] float32, atlas intensities of brain and fluid; zero elsewhere.
        inside: [I, J, K] float32 share of brain and outer fluid: the true mask.
        labels: [I, J, K] uint8 of `Tissue`.
        texture: [I, J, K] float32 noise of unit variance.
        affine: [4, 4] atlas frame (mm) from index.
        base_mm: [3] start of the neck.
        radius_mm: radius of a sphere of the same volume.
    """

    brain: NDArray[np.float32]
    inside: NDArray[np.float32]
    labels: NDArray[np.uint8]
    texture: NDArray[np.float32]
    affine: NDArray[np.float64]
    base_mm: NDArray[np.float64]
    radius_mm: float


def filled_head(volume: TruthVolume) -> TruthVolume:
    """A head whose mask covers everything inside the skull: clefts and holes of the atlas mask are filled with fluid.

    Args:
        volume: in the atlas frame, isotropic.
    """
    spacing = float(np.linalg.norm(volume.affine[:3, 0]))
    margin = int(np.ceil((CLOSING_MM + 4) / spacing))
    mask = np.pad(_largest(volume.mask), margin)
    wide = distance_transform_edt(~mask) * spacing <= CLOSING_MM
    closed = distance_transform_edt(wide) * spacing > CLOSING_MM
    smooth = gaussian_filter((closed | mask).astype(np.float32), SMOOTHING_MM / spacing) > 0.5
    closed = binary_fill_holes(smooth | mask)
    fluid = np.float32(FLUID_INTENSITY)
    data = np.where(closed & ~mask, fluid, np.where(mask, np.pad(volume.data, margin), 0)).astype(np.float32)
    labels = None if volume.labels is None else np.where(mask, np.pad(volume.labels, margin), 0).astype(np.uint8)
    affine = volume.affine.copy()
    affine[:3, 3] -= affine[:3, :3] @ np.full(3, float(margin))
    return replace(volume, data=data, mask=closed, labels=labels, affine=affine, ventricles=None)


def scene_head(volume: TruthVolume, rng: np.random.Generator) -> SceneHead:
    """The head of a scene: a filled head with random outer fluid, skull, scalp, face and neck.

    Args:
        volume: result of `filled_head`, varied or not, in the atlas frame (RAS), isotropic, zero outside its mask.
        rng: source of randomness.
    """
    spacing = float(np.linalg.norm(volume.affine[:3, 0]))
    pad = [[int(AROUND_MM / spacing)] * 2 for _ in range(3)]
    pad[1][1] = pad[2][0] = int(BELOW_MM / spacing)
    mask = np.pad(volume.mask, pad)
    affine = volume.affine.copy()
    affine[:3, 3] -= affine[:3, :3] @ [before for before, _ in pad]
    points: Coordinates = tuple(
        (np.arange(n, dtype=np.float32) * np.float32(spacing) + np.float32(affine[axis, 3])).reshape(
            [-1 if a == axis else 1 for a in range(3)]
        )
        for axis, n in enumerate(mask.shape)
    )  # type: ignore[assignment]
    share = gaussian_filter(mask.astype(np.float32), 0.6)
    # distance from the surface, which is half a voxel from the last voxel inside
    outside_mm = (distance_transform_edt(~mask).astype(np.float32) - 0.5) * np.float32(spacing)
    texture = lattice_noise(mask.shape, float(rng.uniform(1.0, 3.0)), rng)
    radius = float((3 / (4 * np.pi) * mask.sum() * spacing**3) ** (1 / 3))
    low = np.argwhere(mask)
    low = low[low[:, 2] <= low[:, 2].min() + 8 / spacing]
    base = low.mean(0) * spacing + affine[:3, 3]

    labels = _face_and_neck(points, base, radius, lattice_noise(mask.shape, float(rng.uniform(3, 8)), rng), rng)
    # extra fluid, skull and scalp of uneven thickness
    fluid = np.float32(rng.choice([0.0, rng.uniform(0, 2.5)]))
    uneven = np.float32(rng.uniform(0, 0.5)) * lattice_noise(mask.shape, 12.0, rng)
    thin = rng.uniform(size=2) ** 1.5  # mostly thin: between two bright fluids, skull and scalp may be one dark line
    skull = fluid + np.float32(0.6 + 2.2 * thin[0]) * (1 + uneven)
    scalp = skull + np.float32(0.4 + 4.0 * thin[1]) * (1 + uneven)
    labels[outside_mm <= scalp] = Tissue.SCALP
    labels[outside_mm <= skull] = Tissue.SKULL
    if fluid > 0:
        labels[outside_mm <= fluid] = Tissue.CSF
        mask = mask | (outside_mm <= fluid)
        share = gaussian_filter(mask.astype(np.float32), 0.6)
    labels[np.pad(volume.mask, pad)] = Tissue.BRAIN
    return SceneHead(
        brain=np.pad(volume.data, pad),
        inside=share,
        labels=labels,
        texture=texture,
        affine=affine,
        base_mm=base,
        radius_mm=radius,
    )


def _face_and_neck(
    points: Coordinates, base: NDArray[np.float64], radius: float, mosaic: Field, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Labels of face, jaw, neck and eyes; `OUTSIDE` where the surroundings are visible.

    Args:
        points: of the grid (mm).
        base: [3] start of the neck (mm).
        radius: of the head (mm).
        mosaic: [I, J, K] noise that divides the face into tissues.
        rng: source of randomness.
    """
    front, down = 0.62 * radius * rng.uniform(0.9, 1.1), -0.62 * radius * rng.uniform(0.9, 1.1)
    face = ellipsoid(points, (0, front, down), (0.55 * radius, 0.62 * radius, 0.6 * radius))
    # the base of the skull and the jaw are as wide as the head
    jaw = ellipsoid(points, (0, 0.2 * radius, -0.8 * radius), tuple(radius * rng.uniform(0.55, 0.85, 3)))
    tilt = rng.uniform(-0.2, 0.6)
    end = base + np.array([0, tilt, -1.0]) * 70
    thick = radius * rng.uniform(0.4, 0.55)
    neck = tube(points, [tuple(base), tuple(end)], [thick, thick])
    labels = np.zeros(np.broadcast_shapes(*(p.shape for p in points)), np.uint8)
    both = (face > 0) | (neck > 0) | (jaw > 0)
    # the face is a patchwork of tissues in some heads, and almost all muscle in others
    bone, muscle, fat = np.cumsum([rng.uniform(-1.6, -0.6), rng.uniform(0.4, 2.2), rng.uniform(0.4, 1.4)])
    labels[both] = np.select(
        [mosaic[both] < bone, mosaic[both] < muscle, mosaic[both] < fat],
        [Tissue.BONE, Tissue.FACE_MUSCLE, Tissue.FACE_FAT],
        Tissue.FETAL_FLUID,
    )
    # neck muscles and spinal canal can be mistaken for a head: round, with a centre as bright as a ventricle
    inner = tube(points, [tuple(base), tuple(end)], [0.8 * thick, 0.8 * thick])
    labels[(inner > 0) & (mosaic > bone)] = Tissue.FACE_MUSCLE
    canal = tube(points, [tuple(base + np.array([0, 0, 10])), tuple(end)], [6.0, 5.0])
    labels[canal > -2.5] = Tissue.BONE
    labels[canal > 0] = Tissue.FETAL_FLUID
    labels[canal > 2.5] = Tissue.CORD
    eye = radius * rng.uniform(0.17, 0.24)
    for side in (-1, 1):
        at = (side * 0.36 * radius, front + 0.35 * radius, down + 0.15 * radius)
        inside = ellipsoid(points, at, (eye, eye, eye))
        labels[inside > -1.5] = Tissue.BONE
        labels[inside > 0] = Tissue.EYE
    return labels


def _largest(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    parts, n = label(mask)
    return mask if n < 2 else parts == 1 + np.bincount(parts.ravel())[1:].argmax()
