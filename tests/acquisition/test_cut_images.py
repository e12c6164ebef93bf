"""Stacks that were set to zero beyond their masks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from g3r.acquisition.cut_images import cut_at_mask
from tests.gaussians.scenes import slices_of, stack_planes


def test_zeros_beside_the_mask_tell_stacks_that_were_cut() -> None:
    planes = stack_planes(4, 2.0, 12)
    radius_mm = np.linalg.norm(planes.pixel_world_mm(), axis=1)
    # a head in black without noise: pixels beside the mask are partly brain, those further out zero
    value = np.clip((6.0 - radius_mm) / 2.0, 0, 1).astype(np.float32)
    slices = slices_of(planes, value, radius_mm < 4.5, 3, 2.0)
    assert not cut_at_mask(slices).any()
    second = (slices.stack_id == 1)[planes.plane_id()]
    cut = replace(slices, value=np.where(second & ~slices.mask, 0, value).astype(np.float32))
    assert (cut_at_mask(cut) == (slices.stack_id == 1)).all()
    assert not cut_at_mask(replace(slices, mask=np.ones_like(slices.mask))).any()
