"""Settings that stay below a limit of memory, and what is given up for it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from g3r.acquisition.planes import Slices, slices_from_stacks
from g3r.acquisition.stacks import Stack
from g3r.errors import InputError
from g3r.memory.estimate import (
    PAIR_BYTES,
    MemoryEstimate,
    ProblemSizes,
    available_bytes,
    estimate_memory,
    held_bytes,
    sizes_of,
)
from g3r.memory.size import gigabytes
from g3r.presets import ReconstructionSettings

logger = logging.getLogger(__name__)

LEAST_RECORD_BYTES = 20_000_000
PLANNED_HALO_VOXELS = 48
PLANNED_TILES = (128, 96, 64, 48, 32, 16)
"""Edges of tiles that are tried, and how far they look beyond: within 1e-3 of the whole (tests)."""


@dataclass(frozen=True)
class MemoryPlan:
    """Settings that stay below a limit.

    settings; their estimate; limit_bytes (None: no limit); what was changed, as sentences for run.json.
    """

    settings: ReconstructionSettings
    estimate: MemoryEstimate
    limit_bytes: int | None
    changes: list[str]

    def record(self) -> dict[str, Any]:
        """What run.json says."""
        return {
            "stated_bytes": self.estimate.peak,
            "stage": self.estimate.stage,
            "limit_bytes": self.limit_bytes,
            "changes": self.changes,
        }


def plan_memory(
    slices: Slices,
    settings: ReconstructionSettings,
    limit_bytes: int | None,
    n_threads: int = 1,
    process_bytes: int | None = None,
) -> MemoryPlan:
    """Settings that need no more than a limit: what costs seconds goes first, then what costs rounding.

    Args:
        slices: at their header poses.
        settings: as they would be without a limit.
        limit_bytes: None leaves them as they are.
        n_threads: of the kernels.
        process_bytes: what the process holds before; as it is now when None.

    Raises:
        InputError: nothing that may be given up brings it below the limit.
    """
    start = held_bytes() if process_bytes is None else process_bytes

    def estimate(of: ReconstructionSettings) -> MemoryEstimate:
        return estimate_memory(slices, of, n_threads, start)

    found, changes = estimate(settings), list[str]()
    if limit_bytes is None:
        return MemoryPlan(settings, found, None, changes)
    sizes = sizes_of(slices, settings)
    for change in (_fewer_records, _smaller_tiles):
        if found.peak <= limit_bytes:
            break
        settings, said = change(settings, sizes, estimate, limit_bytes)
        changes += said
        found = estimate(settings)
    if found.peak > limit_bytes:
        raise InputError(
            f"--max-memory: needs at least {gigabytes(found.peak)} ({found.stage}), the limit is "
            f"{gigabytes(limit_bytes)}; choose a coarser --resolution, crop the masks, or raise --max-memory"
        )
    return MemoryPlan(settings, found, limit_bytes, changes)


def plan_for_stacks(
    stacks: Sequence[Stack], settings: ReconstructionSettings, limit_bytes: int | None
) -> MemoryPlan:
    """`plan_memory` for this process as it is; says in the log what it found.

    Raises:
        InputError: it does not fit, or the stacks cannot be used.
    """
    import numba

    plan = plan_memory(slices_from_stacks(stacks), settings, limit_bytes, numba.get_num_threads())
    logger.info(plan.estimate.line())
    for change in plan.changes:
        logger.info(change)
    free, more = available_bytes(), plan.estimate.peak - held_bytes()
    if limit_bytes is None and free is not None and more > free:
        logger.warning(
            "%s more of memory needed, %s available: choose a coarser --resolution or --max-memory",
            gigabytes(more), gigabytes(free),
        )  # fmt: skip
    return plan


Estimator = Callable[[ReconstructionSettings], MemoryEstimate]
Change = tuple[ReconstructionSettings, list[str]]


def _fewer_records(
    settings: ReconstructionSettings, sizes: ProblemSizes, estimate: Estimator, limit: int
) -> Change:
    needed = estimate(settings)
    own = round(min(PAIR_BYTES * sizes.n_pairs, settings.slice_stage.record_bytes))
    kept = max(own - (needed.peak - limit), LEAST_RECORD_BYTES)
    less = replace(
        settings,
        prior_stage=replace(settings.prior_stage, record_bytes=kept),
        slice_stage=replace(settings.slice_stage, record_bytes=kept),
    )
    if kept >= own or estimate(less).peak >= needed.peak:
        return settings, []
    return less, [f"memory limit: pairs kept in {kept / 1e6:.0f} MB, else set up again (slower)"]


def _smaller_tiles(
    settings: ReconstructionSettings, sizes: ProblemSizes, estimate: Estimator, limit: int
) -> Change:
    best = settings
    for edge in PLANNED_TILES:
        tiled = replace(
            settings, prior_whole_voxels=0, prior_tile_voxels=edge, prior_halo_voxels=PLANNED_HALO_VOXELS
        )
        if estimate(tiled).peak < estimate(best).peak:
            best = tiled
        if estimate(best).peak <= limit:
            break
    if best is settings:
        return settings, []
    return best, [
        f"memory limit: prior network in tiles of {best.prior_tile_voxels} voxels (slower; within 1e-3)"
    ]
