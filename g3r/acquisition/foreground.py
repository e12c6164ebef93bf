"""The brain mask of the volume, from the masks of slices where slices looked, and by shape where none did.

A voxel is in one of three states: seen and called brain, seen and called something else, or out of the reach of all
slices. The masks say nothing about the last: shape decides there (the prior network's brain probability, or the hull
of the seen brain), never the absence of a mask.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_fill_holes, label
from scipy.spatial import ConvexHull, QhullError

EDGE = (0.03, 0.15)
"""Brain shares between which the volume fades in. Voxels below the first hold next to no brain."""

THIN_MARGIN_VOXELS = 2

FLAT = 1e-6
"""Tolerance in voxels: a voxel that is nearer to a face of the hull lies on it."""

LIKELY, POSSIBLE = 0.5, 0.25
"""Brain probability above which a voxel out of reach is in the mask, and above which it is shown. The second is lower:
a rim voxel that is left out costs as much as many that are a little wrong."""


@dataclass(frozen=True, kw_only=True)
class Foreground:
    """State of each voxel by the slices and their masks.

    Attributes:
        brain: [I, J, K] seen, and brain by more than a third of the slices.
        core: [I, J, K] seen, and brain by more than half of the slices.
        share: [I, J, K] from 0 to 1, how much of a voxel is brain by the masks; 0 where it is hardly seen. With a
            single stack the share is not known; it is 1 in all voxels that are seen.
        out_of_reach: [I, J, K] not seen, and farther from slices than a gap between them: smoothed over half the slice
            spacing, coverage is below a third of one stack's. `unseen.nii.gz` shows gaps, too (`Mixture.seen`).
        thin: [I, J, K] hardly seen or out of reach, gaps between slices included.
        rim_voxels: how far the volume is shown beyond the support, at most.
        possible_voxels: how far beyond the mask the support may reach where no slice looked.
    """

    brain: NDArray[np.bool_]
    core: NDArray[np.bool_]
    share: NDArray[np.float32]
    out_of_reach: NDArray[np.bool_]
    thin: NDArray[np.bool_]
    rim_voxels: int = 1
    possible_voxels: int = 2

    def edge(
        self, support: NDArray[np.bool_], mask: NDArray[np.bool_], brain_probability: NDArray[np.floating] | None = None
    ) -> NDArray[np.float16]:
        """How much of the volume is shown [I, J, K]: 1 in the brain, fading to 0 at its edge.

        Args:
            support: [I, J, K] where the volume is fitted.
            mask: [I, J, K] the brain with its holes filled, shown in full.
            brain_probability: see `mask`; decides where slices hardly looked. Without it the support is shown there.
        """
        low, high = EDGE
        share, full, hardly_seen = self.share, mask, self.out_of_reach | self.thin
        if brain_probability is None:
            full = mask | (hardly_seen & support)
        else:
            share = np.where(hardly_seen, np.maximum(share, brain_probability), share)
        faded = np.clip((share - low) / (high - low), 0, 1)
        near = binary_dilation(mask | support, iterations=self.rim_voxels)
        return np.maximum(faded * near, full).astype(np.float16)

    def support(self, brain_probability: NDArray[np.floating] | None = None) -> NDArray[np.bool_]:
        """Where the volume is fitted and shown [I, J, K]: the mask with a margin of about a voxel.

        With a network the margin is wider where slices hardly looked; `edge` hides what is no brain there.

        Args:
            brain_probability: see `mask`.
        """
        brain = self._completed(self.brain, brain_probability, POSSIBLE)
        if brain_probability is None:
            return brain
        if self.out_of_reach.any():
            near = binary_dilation(self.mask(brain_probability), iterations=self.possible_voxels)
            brain &= near | ~self.out_of_reach
        return brain | (self.thin & binary_dilation(brain, iterations=THIN_MARGIN_VOXELS))

    def mask(self, brain_probability: NDArray[np.floating] | None = None) -> NDArray[np.bool_]:
        """The brain mask [I, J, K]: the seen brain, and the voxels out of reach that are brain by shape.

        Only the largest connected piece is kept, and its holes are filled.

        Args:
            brain_probability: [I, J, K]; without it the convex hull of the seen brain decides.
        """
        return self._completed(self.core if self.core.any() else self.brain, brain_probability, LIKELY)

    def _completed(
        self, seen_brain: NDArray[np.bool_], brain_probability: NDArray[np.floating] | None, least: float
    ) -> NDArray[np.bool_]:
        if not self.out_of_reach.any():
            likely = self.out_of_reach
        elif brain_probability is None:
            likely = _hull(seen_brain, self.out_of_reach)
        else:
            likely = brain_probability > least
        brain = seen_brain | (self.out_of_reach & likely)
        pieces, n_pieces = label(brain)
        if n_pieces > 1:
            brain = pieces == 1 + int(np.argmax(np.bincount(pieces.ravel())[1:]))
        return binary_fill_holes(brain)


def _hull(brain: NDArray[np.bool_], asked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The voxels [I, J, K] of `asked` inside the convex hull of a mask; none where the mask is flat.

    Along a line of voxels on the third axis the hull lies between the nearest of its half-spaces on either side. This
    is as exact as a test of every voxel, and a hundred times faster.
    """
    within = np.zeros_like(brain)
    within[:, :, 1:-1] = brain[:, :, :-2] & brain[:, :, 2:]
    surface = np.argwhere(brain & ~within)
    try:
        faces = np.unique(np.round(ConvexHull(surface).equations, 9), axis=0)  # triangles of one plane are one face
    except QhullError:
        return np.zeros(brain.shape, bool)
    i, j = np.indices(brain.shape[:2])
    low, high = np.full(brain.shape[:2], -np.inf), np.full(brain.shape[:2], np.inf)
    for a, b, c, d in faces:
        beyond = a * i + b * j + d
        if abs(c) < FLAT:
            high = np.where(beyond > FLAT, -np.inf, high)
        elif c > 0:
            high = np.minimum(high, -beyond / c)
        else:
            low = np.maximum(low, -beyond / c)
    k = np.arange(brain.shape[2])
    return np.asarray(asked & (k >= low[:, :, None] - FLAT) & (k <= high[:, :, None] + FLAT))
