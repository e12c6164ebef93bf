"""Atlas templates: mean heads by age, made from the training subjects."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform

from data_synth.atlas import TruthVolume
from data_synth.heads import Subject, load_head, weeks_of
from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.errors import InputError
from g3r.geometry import VolumeGrid

logger = logging.getLogger(__name__)

TEMPLATE_WEEKS = (22.0, 25.0, 28.0, 31.0, 34.0, 37.0)
HALF_WINDOW_WEEKS = 2.0
"""The template of an age is the mean of the subjects within this many weeks of it."""


def atlas_templates(
    subjects: Sequence[Subject],
    spacing_mm: float = 3.0,
    weeks: Sequence[float] = TEMPLATE_WEEKS,
    unknown_weeks: float | None = None,
) -> AtlasTemplate:
    """Mean heads in the atlas frame: centred, normalised, averaged over similar ages, left-right symmetric.

    Each subject is resampled to the template's voxel size, with its mask's centroid at the origin and its 99.5th
    percentile at 1. Subjects are not rotated: both atlases and the phantom are RAS with the mid-sagittal plane at
    constant x. An age without a subject within two weeks is skipped.

    Args:
        subjects: to average.
        spacing_mm: isotropic voxel size of the template.
        weeks: gestational ages of the templates.
        unknown_weeks: age of subjects whose names have none.

    Raises:
        InputError: no subject near any of the ages, or no `unknown_weeks` for a subject without an age in its name.
    """
    ages = np.array([weeks_of(subject, unknown_weeks) for subject in subjects])
    members = {w: np.flatnonzero(np.abs(ages - w) <= HALF_WINDOW_WEEKS + 1e-6) for w in weeks}
    used = [w for w in weeks if len(members[w])]
    if not used:
        raise InputError(
            f"template: none of {len(subjects)} subjects is within {HALF_WINDOW_WEEKS:g} weeks of "
            f"{', '.join(f'{w:g}' for w in weeks)} weeks; add subjects or change the ages"
        )
    if len(used) < len(weeks):
        logger.warning("template: no subject near week %s", sorted(set(weeks) - set(used)))
    needed = sorted({int(k) for w in used for k in members[w]})
    heads = {k: load_head(subjects[k], spacing_mm) for k in needed}
    grid = _common_grid(list(heads.values()), spacing_mm)
    placed = {k: _placed(head, grid) for k, head in heads.items()}
    means = []
    for week in used:
        total, inside = np.sum([placed[int(k)] for k in members[week]], axis=0) / len(members[week])
        # the grid is symmetric about x = 0
        total, inside = (total + total[::-1]) / 2, (inside + inside[::-1]) / 2
        mean = np.where(inside > 0.5, total / np.maximum(inside, 0.5), 0)
        bright = np.percentile(mean[mean > 0], 99.5)
        means.append(np.clip(mean / bright, 0, None).astype(np.float32))
        logger.info("template at %g weeks from %d subjects", week, len(members[week]))
    return AtlasTemplate(np.stack(means), grid.affine, np.array(used))


def _common_grid(heads: Sequence[TruthVolume], spacing_mm: float) -> VolumeGrid:
    """The smallest grid that holds every head and is symmetric about the origin along each axis."""
    reach = np.zeros(3)
    for head in heads:
        corners = np.array([[0, 0, 0], np.array(head.data.shape) - 1])
        reach = np.maximum(reach, np.abs(VolumeGrid(head.data.shape, head.affine).world(corners)).max(0))
    reach = np.ceil(reach / spacing_mm) * spacing_mm
    return VolumeGrid.isotropic(-reach, reach, spacing_mm)


def _placed(head: TruthVolume, grid: VolumeGrid) -> NDArray[np.float32]:
    """A head and its mask [2, I, J, K] on the template's grid, linearly interpolated."""
    index = np.linalg.inv(head.affine) @ grid.affine
    both = (head.data, head.mask.astype(np.float32))
    placed = [affine_transform(one, index[:3, :3], index[:3, 3], grid.shape, order=1) for one in both]
    return np.stack(placed).astype(np.float32)
