"""Refinement of automatic masks after registration: other stacks and the atlas template have a vote.

A network sees one stack, and in slices far from the middle of a head it sees little. The stacks that cross these slices
show the same place better, and the template shows how large a head is. A pixel is brain if most of these votes say so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_fill_holes

from g3r.acquisition.atlas_template import PlacedHead
from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.coverage import UNSEEN_BELOW, brain_share, coverage
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import MIN_SLICE_PIXELS, slices_from_stacks
from g3r.acquisition.stacks import Stack
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import bounding_box, on_grid
from g3r.registration import Registration
from g3r.registration.estimate import measured_again

REFINED = "automatic"
"""Masks of this source are refined; masks drawn by a person, or made by a tool of the user's, are not."""

VOXEL_MM = 2.0
"""Voxel size of the maps of votes."""

MARGIN_MM = 8.0
"""How far beyond a mask it may have missed brain."""

MAX_CHANGE = 0.4
"""A mask that would lose or gain a larger share of itself is kept: the poses are then more likely to be wrong."""


@dataclass(frozen=True, kw_only=True)
class RefinedMasks:
    """Stacks with refined masks, the registration of their slices, and a line on each that changed."""

    stacks: list[Stack]
    poses: Registration
    notes: list[str]


def refine_masks(
    stacks: Sequence[Stack], registration: Registration, intensity: float, template: PlacedHead | None
) -> RefinedMasks:
    """Automatic masks, refined by the majority of the mask itself, each of the other stacks and the template.

    With only two votes a mask stays as it is. Slices keep their poses, and none is added or removed.

    Args:
        stacks: as they were registered.
        registration: of their slices.
        intensity: that these slices were divided by.
        template: in the frame of the slices; None where that is not the atlas frame.
    """
    slices = registration.slices
    present = [int(n) for n in np.unique(slices.stack_id)]
    found = [n for n in present if stacks[n].mask_source == REFINED]
    if not found or (len(present) == 1 and template is None):
        return RefinedMasks(stacks=list(stacks), poses=registration, notes=[])
    grid = grid_around(slices, VOXEL_MM, margin_mm=MARGIN_MM)
    maps = {n: _seen_and_brain(slices.take(slices.stack_id == n), grid) for n in present}
    outline = None if template is None else on_grid((template.volume > 0) * 1.0, template.grid, grid, outside=0.0)
    refined, notes = list(stacks), []
    for n in found:
        others = [maps[m] for m in present if m != n]
        mask = _voted(stacks[n], slices.take(slices.stack_id == n), others, outline, grid)
        before, after = stacks[n].mask, mask
        changed = np.count_nonzero(before != after) / np.count_nonzero(before)
        if changed > MAX_CHANGE:
            notes.append(
                f"{stacks[n].name}: its mask stays as it was found, though the other stacks or the template see the "
                f"brain elsewhere ({changed:.0%} of it)"
            )
        elif changed > 0:
            refined[n] = replace(stacks[n], mask=mask)
            notes.append(f"{stacks[n].name}: its mask was refined by the other stacks and the template ({changed:.1%})")
    rows = slices_from_stacks(refined).scaled(1 / intensity)
    kept = rows.take(_rows_of(slices, rows)).with_motion(slices.world_from_header())
    poses = replace(registration, slices=kept)
    if any(new is not old for new, old in zip(refined, stacks, strict=True)):
        poses = measured_again(poses, template)
    return RefinedMasks(stacks=refined, poses=poses, notes=notes)


def _seen_and_brain(stack: Slices, grid: VolumeGrid) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Where the slices of a stack look [I, J, K], and the masked share of what they see there."""
    density = coverage(stack, grid)
    operator = VoxelOperator(stack.planes, grid, stack.pixel_index)
    amount = stack.pixel_volume_mm3 / grid.voxel_volume_mm3
    masked = operator.adjoint(amount[operator.plane].astype(np.float32))
    return density > UNSEEN_BELOW, brain_share(masked, density)


def _voted(
    stack: Stack,
    slices: Slices,
    others: Sequence[tuple[NDArray[np.bool_], NDArray[np.float32]]],
    outline: NDArray[np.float32] | None,
    grid: VolumeGrid,
) -> NDArray[np.bool_]:
    """The mask [I, J, K] of one stack after the vote.

    Args:
        stack: with its mask.
        slices: of this stack, posed.
        others: of each other stack, where it looks and what share of it is brain.
        outline: [I, J, K] of the template, on the grid; None without one.
        grid: of the maps.
    """
    reach = np.ceil(MARGIN_MM / stack.spacing_mm[:2]).astype(int)
    near = binary_dilation(stack.mask, np.ones((2 * reach[0] + 1, 2 * reach[1] + 1, 1)))
    wide = slices_from_stacks([replace(stack, image=stack.mask.astype(np.float32), mask=near)])
    wide = replace(wide, stack_id=np.full(len(wide), slices.stack_id[0]))
    wide = wide.take(_rows_of(slices, wide)).with_motion(slices.world_from_header())
    at_pixels = VoxelOperator(wide.planes, grid, None, (1, 1, 1))
    own = wide.value > 0.5
    votes, n_voters = own.astype(np.float32), np.ones(len(own), np.float32)
    for seen, share in others:
        n_voters += (sees := at_pixels.forward(seen.astype(np.float32)) > 0.5)
        votes += sees * at_pixels.forward(share)
    if outline is not None:
        n_voters += 1
        votes += at_pixels.forward(outline)
    inside = np.where(n_voters < 3, own, 2 * votes > n_voters) & wide.mask
    mask = stack.mask.copy()
    first = np.cumsum([0, *wide.planes.shape.prod(1)])
    for row, k in enumerate(wide.slice_index):
        box = bounding_box(near[:, :, k])
        voted = binary_fill_holes(inside[first[row] : first[row + 1]].reshape(wide.planes.shape[row]))
        if np.count_nonzero(voted) >= MIN_SLICE_PIXELS:
            mask[:, :, k] = False
            mask[:, :, k][box] = voted
    return mask


def _rows_of(slices: Slices, among: Slices) -> NDArray[np.int64]:
    """Rows of `among` that are these slices, in their order."""
    place = {key: row for row, key in enumerate(zip(among.stack_id.tolist(), among.slice_index.tolist(), strict=True))}
    keys = zip(slices.stack_id.tolist(), slices.slice_index.tolist(), strict=True)
    return np.array([place[key] for key in keys], dtype=np.int64)
