"""What is around a head, and errors of brain extraction: masks that reach beyond the brain, or miss a part of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion

from data_synth.atlas import TruthVolume
from data_synth.mask_head import filled_head, scene_head
from data_synth.mask_labels import Tissue, draw_intensities
from data_synth.noise import lattice_noise
from data_synth.simulator import SimulatedStack

SURROUNDED_SHARE = 0.5
"""How often skull and maternal tissue are seen around the head, and masks reach into them."""
RIM_MM, MISSED_MM = 4.0, 1.5
SMALL_MASK_SHARE = 0.1
"""How often masks miss the head's outermost voxels."""


def in_surroundings(truth: TruthVolume, rng: np.random.Generator) -> TruthVolume:
    """The head in its fluid, skull, scalp, face and neck before blotchy tissue; its mask is all inside the skull.

    Args:
        truth: in the atlas frame (RAS), isotropic, zero outside its mask.
        rng: source of randomness.

    Returns:
        A volume on a larger grid, without labels.
    """
    head = scene_head(filled_head(truth), rng)
    mean, texture = draw_intensities(rng)
    brain = np.zeros(head.labels.shape, bool)
    # grids of voxels of one size, one within the other
    offset = np.rint(np.linalg.solve(head.affine, truth.affine[:, 3])[:3]).astype(int)
    box = tuple(slice(o, o + n) for o, n in zip(offset, truth.mask.shape, strict=True))
    brain[box] = truth.mask
    labels = np.where(head.labels == Tissue.BRAIN, Tissue.CSF, head.labels)  # clefts of the atlas mask hold fluid
    behind = rng.uniform(0.2, 0.9) + rng.uniform(0.1, 0.3) * lattice_noise(labels.shape, 8.0, rng)
    around = np.where(labels == Tissue.OUTSIDE, behind, mean[labels] + (mean * texture)[labels] * head.texture)
    data = np.where(brain, head.brain, np.maximum(around, 0)).astype(np.float32)
    return TruthVolume(name=truth.name, data=data, mask=head.inside > 0.5, affine=head.affine)


def with_mask_errors(stacks: Sequence[SimulatedStack], rng: np.random.Generator, grow: bool) -> list[SimulatedStack]:
    """Stacks whose masks reach too far or not far enough, by a few pixels in plane.

    Args:
        stacks: as simulated.
        rng: source of randomness.
        grow: whether masks reach beyond the skull by up to 4 mm, or miss the head's outermost pixels by up to 1.5 mm.
    """
    result = []
    for one in stacks:
        spacing_mm = float(np.linalg.norm(one.stack.affine[:3, 0]))
        steps = max(1, round(rng.uniform(0.2, 1.0) * (RIM_MM if grow else MISSED_MM) / spacing_mm))
        in_plane = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], bool)[:, :, None]
        change = binary_dilation if grow else binary_erosion
        mask = change(one.stack.mask, in_plane, iterations=steps)
        if mask.any():
            one = replace(one, stack=replace(one.stack, mask=mask))
        result.append(one)
    return result
