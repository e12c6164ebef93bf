"""Settings that stay below a memory limit, and what they give up for it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack
from g3r.errors import InputError
from g3r.planning.memory_estimate import PROJECTION_BYTES, MemoryEstimate, ProblemSizes, estimate_memory, sizes_of
from g3r.planning.memory_size import gigabytes
from g3r.planning.presets import ReconstructionSettings
from g3r.planning.stages import Stage
from g3r.run.allocator import can_release_memory_eagerly, release_memory_eagerly
from g3r.run.machine import available_bytes, held_bytes

logger = logging.getLogger(__name__)

MIN_PROJECTION_BYTES = 20_000_000
STAGES_WITH_PROJECTIONS = (Stage.FIT_TO_PRIOR, Stage.HELD_OUT, Stage.FIT_TO_SLICES, Stage.PRIOR_SHARE)
PLANNED_HALO_VOXELS = 48
PLANNED_TILES = (128, 96, 64, 48, 32, 16)
"""Edges of tiles that are tried, with a halo of `PLANNED_HALO_VOXELS`: within 1e-3 of the whole volume (tests)."""


@dataclass(frozen=True, kw_only=True)
class MemoryPlan:
    """Settings that stay below a limit.

    Attributes:
        settings: changed as far as the limit requires.
        estimate: memory that they need.
        limit_bytes: None without a limit.
        changes: what was given up, as sentences for run.json.
        at_once: whether freed memory has to be returned to the system at once (`release_memory_eagerly`).
    """

    settings: ReconstructionSettings
    estimate: MemoryEstimate
    limit_bytes: int | None
    changes: list[str]
    at_once: bool = False

    def record(self) -> MemoryRecord:
        """The entry of run.json."""
        return MemoryRecord(self.estimate.peak, self.estimate.stage, self.limit_bytes, self.changes)


@dataclass(frozen=True)
class MemoryRecord:
    """Memory as it was stated before the run.

    Attributes:
        stated_bytes: largest memory of any stage.
        stage: that stage.
        limit_bytes: None without a limit.
        changes: what was given up for it.
    """

    stated_bytes: int
    stage: str
    limit_bytes: int | None
    changes: list[str]


def plan_memory(
    slices: Slices,
    settings: ReconstructionSettings,
    limit_bytes: int | None,
    n_threads: int = 1,
    process_bytes: int | None = None,
    *,
    prior_voxel_mm: float | None = None,
) -> MemoryPlan:
    """Settings that need no more than a limit: first what costs time is given up, then what costs rounding errors.

    Args:
        slices: at their header poses.
        settings: as they would be without a limit.
        limit_bytes: None leaves them as they are.
        n_threads: of the kernels.
        process_bytes: memory of the process before; its present memory when None.
        prior_voxel_mm: voxel size of the prior; that of the output when None.

    Raises:
        InputError: nothing that may be given up brings the memory below the limit.
    """

    def estimate(of: ReconstructionSettings, at_once: bool = False) -> MemoryEstimate:
        return estimate_memory(slices, of, n_threads, process_bytes, prior_voxel_mm=prior_voxel_mm, at_once=at_once)

    def sizes() -> ProblemSizes:
        return sizes_of(slices, settings, prior_voxel_mm)

    plan = _lowered(sizes, settings, limit_bytes, estimate)
    needed = plan.estimate
    if limit_bytes is not None and needed.peak > limit_bytes:
        remedy = "choose a coarser --resolution, crop the masks, or raise --max-memory"
        if settings.use_prior:
            without = _lowered(sizes, replace(settings, use_prior=False), limit_bytes, estimate).estimate
            if without.peak <= limit_bytes:
                remedy = f"raise --max-memory, or take --no-prior ({gigabytes(without.peak)})"
        raise InputError(
            f"--max-memory: needs at least {gigabytes(needed.peak)} ({needed.stage}), the limit is "
            f"{gigabytes(limit_bytes)}; {remedy}"
        )
    return plan


def plan_for_stacks(
    stacks: Sequence[Stack],
    settings: ReconstructionSettings,
    limit_bytes: int | None,
    prior_voxel_mm: float | None = None,
) -> MemoryPlan:
    """`plan_memory` for this process as it is; makes it return memory to the system at once where the plan requires it.

    Args:
        stacks: that will be reconstructed.
        settings: as they would be without a limit.
        limit_bytes: None leaves them as they are.
        prior_voxel_mm: voxel size of the prior; that of the output when None.

    Raises:
        InputError: the limit is too low, or the stacks cannot be used.
    """
    import numba

    slices, n_threads = slices_from_stacks(stacks), numba.get_num_threads()
    plan = plan_memory(slices, settings, limit_bytes, n_threads, prior_voxel_mm=prior_voxel_mm)
    if plan.at_once:
        release_memory_eagerly()
    logger.info(plan.estimate.line())
    for change in plan.changes:
        logger.info(change)
    free, more = available_bytes(), plan.estimate.peak - held_bytes()
    if limit_bytes is None and more > free:
        logger.warning(
            "%s more of memory needed, %s available: choose a coarser --resolution or --max-memory",
            gigabytes(more),
            gigabytes(free),
        )
    return plan


class Estimator(Protocol):
    """`estimate_memory` of one problem."""

    def __call__(self, of: ReconstructionSettings, at_once: bool = False) -> MemoryEstimate:
        """Memory that settings need."""
        ...


def _lowered(
    sizes: Callable[[], ProblemSizes], settings: ReconstructionSettings, limit: int | None, estimate: Estimator
) -> MemoryPlan:
    """Settings changed until they need no more than the limit, or nothing is left to change."""
    found = estimate(settings)
    if limit is None or found.peak <= limit:
        return MemoryPlan(settings=settings, estimate=found, limit_bytes=limit, changes=[])
    changes = []
    at_once = can_release_memory_eagerly()
    if at_once:
        changes.append("memory limit: freed memory is given back at once (slower)")
    stages = estimate(settings, at_once).stages
    with_projections = max(stages.get(name, 0) for name in STAGES_WITH_PROJECTIONS)
    less = _fewer_projections(settings, sizes(), with_projections - limit)
    if less is not settings:
        kept = less.slice_stage.projection_bytes
        changes.append(f"memory limit: projections kept in {kept / 1e6:.0f} MB, others computed again (slower)")
    tiled = _smaller_tiles(less, lambda of: estimate(of, at_once).peak, limit)
    if tiled is not less:
        edge = tiled.prior_tile_voxels
        changes.append(f"memory limit: prior network in tiles of {edge} voxels (slower; within 1e-3)")
    estimated = estimate(tiled, at_once)
    return MemoryPlan(settings=tiled, estimate=estimated, limit_bytes=limit, changes=changes, at_once=at_once)


def _fewer_projections(
    settings: ReconstructionSettings, sizes: ProblemSizes, excess_bytes: int
) -> ReconstructionSettings:
    """Settings whose kept projections take `excess_bytes` less."""
    own = round(min(PROJECTION_BYTES * sizes.n_pairs, settings.slice_stage.projection_bytes))
    kept = max(own - max(excess_bytes, 0), MIN_PROJECTION_BYTES)
    if kept >= own:
        return settings
    return replace(
        settings,
        prior_stage=replace(settings.prior_stage, projection_bytes=kept),
        slice_stage=replace(settings.slice_stage, projection_bytes=kept),
    )


def _smaller_tiles(
    settings: ReconstructionSettings, peak: Callable[[ReconstructionSettings], int], limit: int
) -> ReconstructionSettings:
    best = settings
    for edge in PLANNED_TILES:
        if peak(best) <= limit:
            break
        tiled = replace(settings, prior_whole_voxels=0, prior_tile_voxels=edge, prior_halo_voxels=PLANNED_HALO_VOXELS)
        if peak(tiled) < peak(best):
            best = tiled
    return best
