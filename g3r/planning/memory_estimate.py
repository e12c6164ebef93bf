"""Estimate of the memory that each stage of a reconstruction takes, stated before it starts.

Bytes follow from sizes that are known beforehand: pixels, the grid that the masks need at their header poses,
the voxels of the output, the Gaussians that the head holds. The factors are measured (`python -m
studies.tradeoff.memory`, docs/tradeoff.md): they are on the safe side, and cover what the allocator keeps.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

from g3r.acquisition.area_profile import head_volume_mm3
from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.planes import Slices
from g3r.acquisition.voxel_operator import MAX_SCATTER_BUFFERS
from g3r.fitting.initial_volumes import MARGIN_MM
from g3r.fitting.voxel_problem import too_fine
from g3r.planning.memory_size import gigabytes
from g3r.planning.presets import ReconstructionSettings
from g3r.planning.stages import Stage
from g3r.run.kernel_cache import needs_compiling
from g3r.run.machine import held_bytes

GRID_SLACK = 1.1
"""Factor on the voxels of the box at header poses, for heads that are turned into the atlas frame."""

PROJECTION_BYTES = 48
"""Bytes of a stored projection of a Gaussian on a plane (`gaussians.kernels.PROJECTION`)."""


@dataclass(frozen=True)
class MemoryEstimate:
    """Peak memory of each stage in bytes, including the process with its libraries."""

    stages: dict[Stage, int]

    @property
    def stage(self) -> Stage:
        """The stage that needs most."""
        return max(self.stages, key=lambda name: self.stages[name])

    @property
    def peak(self) -> int:
        """Memory of that stage in bytes."""
        return self.stages[self.stage]

    def line(self) -> str:
        """The line for the terminal."""
        return f"needs about {gigabytes(self.peak)} of memory, most of it in {self.stage}"


@dataclass(frozen=True, kw_only=True)
class ProblemSizes:
    """Counts that the estimate is made from: pixels, voxels, Gaussians, and pairs of Gaussian and plane."""

    n_pixels: int
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
    *,
    prior_voxel_mm: float | None = None,
    at_once: bool = False,
) -> MemoryEstimate:
    """Memory of every stage, from sizes alone.

    Args:
        slices: at their header poses.
        settings: of the reconstruction.
        n_threads: of the kernels.
        process_bytes: memory of the process before; its present memory when None.
        prior_voxel_mm: voxel size of the prior; that of the output when None.
        at_once: with `release_memory_eagerly`.
    """
    sizes = sizes_of(slices, settings, prior_voxel_mm)
    start = held_bytes() + _libraries_to_come(settings) if process_bytes is None else process_bytes
    buffers = min(n_threads, MAX_SCATTER_BUFFERS)
    n_pixels, voxels, output = sizes.n_pixels, sizes.prior_voxels, sizes.output_voxels
    base = (LIBRARIES_LATER_AT_ONCE if at_once else LIBRARIES_LATER) + SLICES_PER_PIXEL * n_pixels
    base -= 0 if settings.n_lattices else FIT_LIBRARIES
    volumes = base + VOLUMES_PER_VOXEL * voxels
    projections = min(PROJECTION_BYTES * sizes.n_pairs, settings.slice_stage.projection_bytes)
    cloud = CLOUD_PER_GAUSSIAN * (1 + n_threads) * sizes.n_gaussians + PAIR_INDEX_BYTES * sizes.n_pairs
    prior_projections = min(PROJECTION_BYTES * sizes.n_pairs, settings.prior_stage.projection_bytes)
    outputs = volumes + OUTPUTS_PER_VOXEL * output + settings.n_lattices * cloud
    stages = {
        Stage.LOADING: base,
        Stage.REGISTRATION: base + REGISTRATION_PER_PIXEL * n_pixels + 4 * (1 + buffers) * voxels,
        Stage.COARSE: volumes + COARSE_PER_PIXEL * n_pixels + 4 * (COARSE_VOLUMES + buffers) * voxels,
    }
    if settings.use_prior:
        seen = _seen_voxels(sizes.prior_shape, settings)
        begin, per_voxel = NETWORK_AT_ONCE if at_once else NETWORK
        network = begin + per_voxel * seen + MAPS_PER_VOXEL * voxels
        stages[Stage.PRIOR] = volumes + max(network, TEMPLATE_FIT_PER_VOXEL * voxels)
    fit = projections + FIT_PER_PIXEL * n_pixels + TARGET_PER_VOXEL * voxels
    rim = COARSE_PER_PIXEL * n_pixels + 4 * (RIM_VOLUMES + buffers) * voxels
    stages[Stage.VOLUME] = outputs + MASK_PER_PIXEL * n_pixels + 4 * (MASK_VOLUMES + buffers) * output
    stages[Stage.WRITING] = outputs + WRITING_PER_VOXEL * output
    if not settings.n_lattices:
        stages[Stage.PRIOR] = max(stages.get(Stage.PRIOR, 0), volumes + rim)  # by least squares
        # masks are read from the prior's grid, and there are no maps to write
        stages[Stage.VOLUME] = outputs + READ_MASKS_PER_VOXEL * output
        stages[Stage.WRITING] = outputs + WRITING_ALONE_PER_VOXEL * output
        return MemoryEstimate({name: round(start + own) for name, own in stages.items()})
    stages |= {
        Stage.FIT_TO_PRIOR: volumes + cloud + prior_projections + TARGET_PER_VOXEL * voxels,
        Stage.FIT_TO_SLICES: volumes + cloud + max(fit, rim),
    }
    # the correction on voxels, and the edge by the image
    edge_on = 0.0 if too_fine(settings.resolution_mm, slices) else output
    solved_on = edge_on if settings.voxel_correction is None else max(voxels, edge_on)
    on_voxels = COARSE_PER_PIXEL * n_pixels + 4 * (CORRECTION_VOLUMES + buffers) * solved_on
    stages[Stage.VOLUME] = max(stages[Stage.VOLUME], outputs + on_voxels)
    if settings.held_out is not None:
        stages[Stage.HELD_OUT] = stages[Stage.FIT_TO_SLICES]
    if settings.pose_rounds.n_rounds(slices.n_stacks):
        # the volumes before a round are kept until those after it are made
        inner = max(stages[Stage.COARSE], stages[Stage.FIT_TO_SLICES], stages.get(Stage.PRIOR, 0))
        stages[Stage.POSE_ROUNDS] = inner + VOLUMES_PER_VOXEL * voxels
    if settings.use_prior:
        stages[Stage.PRIOR_SHARE] = outputs + projections + SHARE_PER_PIXEL * n_pixels + SHARE_PER_VOXEL * output
    stages[Stage.UNCERTAINTY] = outputs + SHARE_PER_PIXEL * n_pixels + PREDICTORS_PER_VOXEL * output
    return MemoryEstimate({name: round(start + own) for name, own in stages.items()})


# Bytes, measured; see the module's docstring.
# The memory of the compiler, in a run that finds no kernel compiled, is 250 MB with a fit and 150 MB without one, by
# the peaks of a small run with NUMBA_CACHE_DIR at an empty folder and again at the same one. Part of it counts as a
# library; the rest of the 250 MB is added where nothing is compiled. SimpleITK takes 80 MB.
LIBRARIES_LATER, LIBRARIES_LATER_AT_ONCE = 315_000_000, 275_000_000
COMPILER_BYTES = 80_000_000
FIT_LIBRARIES = 90_000_000  # the part of these, beside torch, that a run without Gaussians does not load or compile
READ_MASKS_PER_VOXEL, WRITING_ALONE_PER_VOXEL = 12, 14  # of a run without Gaussians
SLICES_PER_PIXEL = 45
VOLUMES_PER_VOXEL = 20
REGISTRATION_PER_PIXEL = 150
COARSE_PER_PIXEL, COARSE_VOLUMES = 130, 5
NETWORK, NETWORK_AT_ONCE = (60_000_000, 130), (20_000_000, 100)  # to begin with, and per voxel
# Share, template and outline, all six maps padded, and the two results; the template on the whole grid.
MAPS_PER_VOXEL, TEMPLATE_FIT_PER_VOXEL = 44, 115
CLOUD_PER_GAUSSIAN, PAIR_INDEX_BYTES = 500, 8
TARGET_PER_VOXEL, FIT_PER_PIXEL, RIM_VOLUMES = 12, 60, 8
OUTPUTS_PER_VOXEL, MASK_PER_PIXEL, MASK_VOLUMES = 12, 60, 5
CORRECTION_VOLUMES = 17
TORCH_BYTES, MONAI_BYTES = 195_000_000, 126_000_000  # the second without `lean_import`
SHARE_PER_PIXEL, SHARE_PER_VOXEL, PREDICTORS_PER_VOXEL, WRITING_PER_VOXEL = 60, 18, 70, 26


def _libraries_to_come(settings: ReconstructionSettings) -> int:
    """Memory of the libraries that will be imported on demand, and of the compiler if it has work to do."""
    torch = TORCH_BYTES if settings.n_lattices and "torch" not in sys.modules else 0
    monai = MONAI_BYTES if settings.use_prior and "monai" not in sys.modules else 0
    compiler = COMPILER_BYTES if settings.n_lattices and needs_compiling("gaussians") else 0
    return torch + monai + compiler


def sizes_of(slices: Slices, settings: ReconstructionSettings, prior_voxel_mm: float | None = None) -> ProblemSizes:
    """Sizes of a reconstruction.

    Args:
        slices: at their header poses.
        settings: of the reconstruction.
        prior_voxel_mm: voxel size of the prior; that of the output when None.
    """
    own_voxel_mm = max(settings.resolution_mm, settings.least_squares_voxel_mm)
    voxel_mm = prior_voxel_mm if settings.use_prior and prior_voxel_mm else own_voxel_mm
    grid = grid_around(slices, voxel_mm, MARGIN_MM)
    n_voxels = GRID_SLACK * math.prod(grid.shape)
    spacing_mm = settings.lattice.mm(slices)
    n_gaussians = head_volume_mm3(slices) / spacing_mm**3
    n_stacks = slices.n_stacks
    # how far a Gaussian reaches along a plane's normal, and how many planes of a stack that covers
    reach_mm = (
        2
        * (settings.slice_stage.cutoff_sigma + 1)
        * math.hypot(0.8 * spacing_mm, float(slices.thickness_mm.max()) / 2.355)
    )
    per_stack = reach_mm / float(slices.thickness_mm.min())
    in_prior = reach_mm / voxel_mm
    return ProblemSizes(
        n_pixels=slices.planes.n_pixels,
        prior_shape=grid.shape,
        prior_voxels=n_voxels,
        output_voxels=n_voxels * (voxel_mm / settings.resolution_mm) ** 3,
        n_gaussians=n_gaussians,
        n_pairs=n_gaussians * max(n_stacks * per_stack, in_prior),
    )


def _seen_voxels(shape: tuple[int, ...], settings: ReconstructionSettings) -> float:
    """Voxels that the prior network processes at a time."""
    n_voxels = GRID_SLACK * math.prod(shape)
    if n_voxels <= settings.prior_whole_voxels:
        return n_voxels
    widest = settings.prior_tile_voxels + 2 * settings.prior_halo_voxels
    return math.prod(min(GRID_SLACK ** (1 / 3) * extent, widest) for extent in shape)
