"""Tissue labels of the scenes that the mask network is trained on, and their random intensities."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Tissue(IntEnum):
    """Labels of a scene; `OUTSIDE` is transparent in the head's volume, and air in the volume of the surroundings."""

    OUTSIDE = 0
    BRAIN = 1
    CSF = 2
    SKULL = 3
    SCALP = 4
    FACE_MUSCLE = 5
    FACE_FAT = 6
    EYE = 7
    BONE = 8
    CORD = 9
    FETAL_BODY = 10
    LUNG = 11
    LIVER = 12
    FETAL_FLUID = 13
    AMNIOTIC = 14
    UTERUS = 15
    PLACENTA = 16
    MUSCLE = 17
    FAT = 18
    ORGAN_A = 19
    ORGAN_B = 20
    ORGAN_C = 21
    ORGAN_D = 22
    MATERNAL_FLUID = 23
    VESSEL = 24
    DISTRACTOR = 25


_T2: dict[Tissue, tuple[float, float, float]] = {
    Tissue.CSF: (0.95, 0.12, 0.05),
    Tissue.SKULL: (0.16, 0.5, 0.1),
    Tissue.SCALP: (0.5, 0.35, 0.15),
    Tissue.FACE_MUSCLE: (0.3, 0.4, 0.3),
    Tissue.FACE_FAT: (0.6, 0.3, 0.3),
    Tissue.EYE: (0.95, 0.15, 0.05),
    Tissue.BONE: (0.18, 0.5, 0.3),
    Tissue.CORD: (0.55, 0.2, 0.1),
    Tissue.FETAL_BODY: (0.38, 0.35, 0.3),
    Tissue.LUNG: (0.6, 0.3, 0.2),
    Tissue.LIVER: (0.27, 0.35, 0.15),
    Tissue.FETAL_FLUID: (0.95, 0.15, 0.1),
    Tissue.AMNIOTIC: (1.0, 0.18, 0.06),
    Tissue.UTERUS: (0.33, 0.4, 0.25),
    Tissue.PLACENTA: (0.5, 0.25, 0.12),
    Tissue.MUSCLE: (0.16, 0.4, 0.2),
    Tissue.FAT: (0.6, 0.4, 0.12),
    Tissue.ORGAN_A: (0.3, 0.5, 0.4),
    Tissue.ORGAN_B: (0.45, 0.5, 0.4),
    Tissue.ORGAN_C: (0.15, 0.6, 0.4),
    Tissue.ORGAN_D: (0.7, 0.5, 0.4),
    Tissue.MATERNAL_FLUID: (1.05, 0.25, 0.1),
    Tissue.VESSEL: (0.08, 0.8, 0.2),
    Tissue.DISTRACTOR: (0.55, 0.3, 0.2),
}
"""Per tissue: mean T2 signal (the brain's 99.5th percentile is 1), standard deviation of its logarithm between scans,
largest relative standard deviation of its texture."""

ANYTHING_SHARE = 0.2
"""Share of scans with uniformly random tissue intensities."""
DARK_SKULL_SHARE = 0.7
"""Share of scans with random intensities whose skull keeps its usual dark intensity."""
MAX_ANY_TEXTURE = 0.4


def draw_intensities(rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean intensity of each tissue of one scan [T], and the relative standard deviation of its texture [T].

    The brain's entries are 0, because its intensities come from the atlas.
    """
    mean, texture = np.zeros((2, len(Tissue)), np.float32)
    anything = rng.random() < ANYTHING_SHARE
    for tissue, (usual, spread, grain) in _T2.items():
        mean[tissue] = usual * np.exp(rng.normal(0, spread))
        texture[tissue] = rng.uniform(0.2, 1.0) * grain
        if anything and not (tissue is Tissue.SKULL and rng.random() < DARK_SKULL_SHARE):
            mean[tissue], texture[tissue] = rng.uniform(0, 1.2), rng.uniform(0, MAX_ANY_TEXTURE)
    return mean, texture


def textured(
    labels: NDArray[np.integer], noise: NDArray[np.float32], mean: NDArray[np.float32], texture: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Intensities of voxels, not negative.

    Args:
        labels: tissue of each voxel, any shape.
        noise: of the same shape, of standard deviation 1.
        mean: intensity of each tissue, see `draw_intensities`.
        texture: standard deviation in each tissue, as a share of its intensity.
    """
    return np.maximum(mean[labels] + (mean * texture)[labels] * noise, 0)
