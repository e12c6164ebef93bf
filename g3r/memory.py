"""How much memory a reconstruction takes, stated before it starts, and what is given up to take less.

Bytes follow from sizes that are known beforehand: pixels, the grid that the masks need at their header poses,
the voxels of the output, the Gaussians that the head holds. The factors are measured (`python -m
benchmarks.memory`, docs/tradeoff.md): they are on the safe side, and cover what the allocator keeps.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from g3r.acquisition.planes import Slices, slices_from_stacks
from g3r.acquisition.stacks import Stack
from g3r.errors import InputError
from g3r.memory_size import gigabytes
from g3r.motion.template_registration import head_volume_mm3
from g3r.motion.volume import grid_around
from g3r.presets import ReconstructionSettings

logger = logging.getLogger(__name__)

MARGIN_MM = 5.0
"""Around the masked pixels, as the reconstruction's own grid has it."""

GRID_SLACK = 1.1
"""Voxels over those of the box at header poses: heads that were turned into the atlas frame."""

USUAL_PROCESS_BYTES = 500_000_000
"""Python with the libraries and networks loaded, where the system does not tell."""

PAIR_BYTES = 48
"""A kept record of a pair (`gaussians.kernels.PAIR`)."""

LEAST_RECORD_BYTES = 20_000_000
PLANNED_HALO_VOXELS = 48
PLANNED_TILES = (128, 96, 64, 48, 32, 16)
"""Edges of tiles that are tried, and how far they look beyond: within 1e-3 of the whole (tests)."""


@dataclass(frozen=True)
class MemoryEstimate:
    """What each stage holds at most, in bytes, the process with its libraries included."""

    stages: dict[str, int]

    @property
    def stage(self) -> str:
        """Which one needs most."""
        return max(self.stages, key=lambda name: self.stages[name])

    @property
    def peak(self) -> int:
        """What that one needs."""
        return self.stages[self.stage]

    def line(self) -> str:
        """The statement for people."""
        return f"needs about {gigabytes(self.peak)} of memory, most of it in {self.stage}"


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


@dataclass(frozen=True)
class _Sizes:
    """What the estimate is made of."""

    n_pixels: int
    n_stacks: int
    prior_shape: tuple[int, ...]
    prior_voxels: float
    output_voxels: float
    n_gaussians: float
    n_pairs: float


def estimate_memory(
    slices: Slices,
    settings: ReconstructionSettings,
    n_threads: int = 1,
    process_bytes: int | None = None,
) -> MemoryEstimate:
    """Memory of every stage, from sizes alone.

    Args:
        slices: at their header poses.
        settings: of the reconstruction.
        n_threads: of the kernels.
        process_bytes: what the process holds before; as it is now when None.
    """
    sizes = _sizes_of(slices, settings)
    start = held_bytes() if process_bytes is None else process_bytes
    buffers = min(n_threads, settings.scatter_buffers)
    n_pixels, voxels, output = sizes.n_pixels, sizes.prior_voxels, sizes.output_voxels
    resting = LIBRARIES_LATER + SLICES_PER_PIXEL * n_pixels
    volumes = resting + VOLUMES_PER_VOXEL * voxels
    records = min(PAIR_BYTES * sizes.n_pairs, settings.slice_stage.record_bytes)
    cloud = CLOUD_PER_GAUSSIAN * (1 + n_threads) * sizes.n_gaussians + PAIR_INDEX_BYTES * sizes.n_pairs
    prior_records = min(PAIR_BYTES * sizes.n_pairs, settings.prior_stage.record_bytes)
    outputs = volumes + OUTPUTS_PER_VOXEL * output + cloud
    stages = {
        "loading": resting,
        "motion": resting + MOTION_PER_PIXEL * n_pixels + 4 * (1 + buffers) * voxels,
        "coarse volumes": volumes + COARSE_PER_PIXEL * n_pixels + 4 * (COARSE_VOLUMES + buffers) * voxels,
    }
    if settings.use_prior:
        seen = _seen_voxels(sizes.prior_shape, settings)
        stages["prior network"] = volumes + NETWORK_START + NETWORK_PER_VOXEL * seen + 16 * voxels
    stages |= {
        "fit to prior": volumes + cloud + prior_records + TARGET_PER_VOXEL * voxels,
        "fit to slices": volumes + cloud + records + FIT_PER_PIXEL * n_pixels + TARGET_PER_VOXEL * voxels,
        "volume": outputs + MASK_PER_PIXEL * n_pixels + 4 * (MASK_VOLUMES + buffers) * output,
    }
    if settings.use_prior:
        stages["prior share"] = outputs + records + SHARE_PER_PIXEL * n_pixels + 12 * output
    stages["uncertainty"] = outputs + SHARE_PER_PIXEL * n_pixels + EVIDENCE_PER_VOXEL * output
    stages["writing"] = outputs + WRITING_PER_VOXEL * output
    return MemoryEstimate({name: round(start + own) for name, own in stages.items()})


# Bytes, measured; see the module's docstring.
LIBRARIES_LATER = 110_000_000
SLICES_PER_PIXEL = 45
VOLUMES_PER_VOXEL = 20
MOTION_PER_PIXEL = 150
COARSE_PER_PIXEL, COARSE_VOLUMES = 130, 5
NETWORK_START, NETWORK_PER_VOXEL = 60_000_000, 150
CLOUD_PER_GAUSSIAN, PAIR_INDEX_BYTES = 500, 8
TARGET_PER_VOXEL, FIT_PER_PIXEL = 12, 60
OUTPUTS_PER_VOXEL, MASK_PER_PIXEL, MASK_VOLUMES = 12, 60, 5
SHARE_PER_PIXEL, EVIDENCE_PER_VOXEL, WRITING_PER_VOXEL = 60, 40, 16


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
    sizes = _sizes_of(slices, settings)
    for change in (_fewer_buffers, _fewer_records, _smaller_tiles):
        if found.peak <= limit_bytes:
            break
        settings, said = change(settings, sizes, estimate, limit_bytes, n_threads)
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


def _fewer_buffers(
    settings: ReconstructionSettings, sizes: _Sizes, estimate: Estimator, limit: int, n_threads: int
) -> Change:
    most = min(settings.scatter_buffers, n_threads)
    for n_buffers in range(most - 1, 0, -1):
        less = replace(settings, scatter_buffers=n_buffers)
        if estimate(less).peak < estimate(settings).peak:
            settings = less
        if estimate(settings).peak <= limit:
            break
    if settings.scatter_buffers >= most:
        return settings, []
    return settings, [f"memory limit: {settings.scatter_buffers} of {most} threads scatter (slower)"]


def _fewer_records(
    settings: ReconstructionSettings, sizes: _Sizes, estimate: Estimator, limit: int, n_threads: int
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
    settings: ReconstructionSettings, sizes: _Sizes, estimate: Estimator, limit: int, n_threads: int
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


def _sizes_of(slices: Slices, settings: ReconstructionSettings) -> _Sizes:
    voxel_mm = settings.prior_voxel_mm if settings.use_prior else settings.resolution_mm
    grid = grid_around(slices, voxel_mm, MARGIN_MM)
    n_voxels = GRID_SLACK * math.prod(grid.shape)
    spacing_mm = settings.gaussian_spacing_pixels * slices.pixel_edge_mm
    n_gaussians = head_volume_mm3(slices) / spacing_mm**3
    n_stacks = len(np.unique(slices.stack_id))
    # a Gaussian reaches so far along a plane's normal, and so many planes of a stack lie within
    reach_mm = (
        2
        * (settings.slice_stage.cutoff_sigma + 1)
        * math.hypot(0.8 * spacing_mm, float(slices.thickness_mm.max()) / 2.355)
    )
    per_stack = reach_mm / float(slices.thickness_mm.min())
    in_prior = reach_mm / voxel_mm
    return _Sizes(
        slices.planes.n_pixels, n_stacks, grid.shape, n_voxels,
        n_voxels * (voxel_mm / settings.resolution_mm) ** 3, n_gaussians,
        n_gaussians * max(n_stacks * per_stack, in_prior),
    )  # fmt: skip


def _seen_voxels(shape: tuple[int, ...], settings: ReconstructionSettings) -> float:
    """What the prior network sees at a time."""
    n_voxels = GRID_SLACK * math.prod(shape)
    if n_voxels <= settings.prior_whole_voxels:
        return n_voxels
    widest = settings.prior_tile_voxels + 2 * settings.prior_halo_voxels
    return math.prod(min(GRID_SLACK ** (1 / 3) * extent, widest) for extent in shape)


def held_bytes() -> int:
    """What this process holds now."""
    return _kilobytes(Path("/proc/self/status"), "VmRSS") or USUAL_PROCESS_BYTES


def available_bytes() -> int | None:
    """What the machine could still give; None where it does not tell."""
    return _kilobytes(Path("/proc/meminfo"), "MemAvailable")


def _kilobytes(path: Path, field: str) -> int | None:
    try:
        lines = path.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return None
    for line in lines:
        if line.startswith(f"{field}:"):
            return int(line.split()[1]) * 1024
    return None
