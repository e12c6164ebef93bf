"""Random contrasts of a labelled head: each tissue gets a new mean intensity and keeps its inner structure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from data_synth.atlas import TruthVolume

NEAR_SHARE = 0.5
"""Probability that intensities stay near the true ones (as with another field strength or echo time). Otherwise they
are drawn uniformly for every tissue (Billot et al. 2023, SynthSeg)."""

NEAR_DEVIATION = 0.12
INTENSITY_RANGE = (0.1, 1.0)
STRUCTURE_RANGE = (0.4, 1.6)
"""Range of the factor on intensity variation inside a tissue."""

PARTIAL_VOLUME_VOXELS = 0.4
"""Smoothing of the labels: a voxel on a border is a mixture of tissues."""


def recoloured(head: TruthVolume, rng: np.random.Generator) -> TruthVolume:
    """A labelled head with random tissue intensities.

    The result is sum_l p_l (m_l + g_l (T - t_l)): p_l the share of tissue l in a voxel, t_l its mean in the
    true image T, m_l its new mean and g_l a factor on its structure.

    Args:
        head: with labels; a head without labels is returned unchanged.
        rng: source of randomness.
    """
    if head.labels is None:
        return head
    labels = np.where(head.mask, head.labels, 0)
    found = [int(label) for label in np.unique(labels[head.mask])]
    near = rng.random() < NEAR_SHARE
    total = np.zeros(head.data.shape, np.float32)
    weight = np.full(head.data.shape, 1e-6, np.float32)
    for label in found:
        inside = (labels == label) & head.mask
        mean = float(head.data[inside].mean())
        new = mean + rng.normal(0, NEAR_DEVIATION) if near else rng.uniform(*INTENSITY_RANGE)
        new, factor = max(new, 0.02), rng.uniform(*STRUCTURE_RANGE)
        share = _share(inside)
        total += share * (np.float32(new) + np.float32(factor) * (head.data - np.float32(mean)))
        weight += share
    data = np.clip(total / weight, 0, None)
    return replace(head, data=np.where(head.mask, data, 0).astype(np.float32))


def _share(inside: NDArray[np.bool_]) -> NDArray[np.float32]:
    return gaussian_filter(inside.astype(np.float32), PARTIAL_VOLUME_VOXELS, truncate=3.0)
