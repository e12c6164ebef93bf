"""The volumes that lead to a prior (coarse, sharp, prior) of a simulated subject, and their scores."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter
from scipy.spatial.transform import Rotation

from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.coarse_volume import coarse_and_density, normalisation_scale
from g3r.acquisition.images import Volume
from g3r.acquisition.least_squares import sharpened_volume
from g3r.acquisition.planes import Slices, slices_from_stacks
from g3r.evaluation.case import SimulatedCase
from g3r.evaluation.compare import compare
from g3r.evaluation.metrics import Scores
from g3r.geometry import RigidPose, VolumeGrid

if TYPE_CHECKING:
    from g3r.prior.dgpn import DensityGatedPriorNetwork

MARGIN_MM = 5.0
"""Around the slices, as the reconstruction has it."""

ALIGNMENT_POINTS = 120_000
"""Voxels of the mask that the alignment looks at, evenly spread."""

ALIGNMENT_STEPS = 8
SMALL_STEP = 1e-4
"""A step of at most this (rad, and mm) ends the alignment."""


@dataclass(frozen=True)
class PriorVolumes:
    """What the network is given and answers, [I, J, K] in normalised intensities.

    Attributes:
        by_name: `V_coarse` (Eq. 6), `V_sharp` and `V_prior` (Eq. 7).
        density: M_rho.
        grid: of all of them.
        seconds: wall time of each step.
    """

    by_name: dict[str, NDArray[np.float32]]
    density: NDArray[np.float32]
    grid: VolumeGrid
    seconds: dict[str, float]


def slices_at_true_poses(case: SimulatedCase, n_stacks: int) -> Slices:
    """The first stacks' slices where they were truly taken; slices of unknown pose are left out."""
    slices = slices_from_stacks(case.stacks[:n_stacks])
    row_of = {key: row for row, key in enumerate(case.true.keys)}
    keys = list(zip(slices.stack_id.tolist(), slices.slice_index.tolist(), strict=True))
    known = np.flatnonzero([key in row_of for key in keys])
    slices = slices.take(known)
    rows = np.array([row_of[keys[n]] for n in known])
    return slices.with_pose(case.true.pose.take(rows) @ slices.header_pose)


def prior_volumes(network: DensityGatedPriorNetwork, slices: Slices, voxel_mm: float, n_views: int = 1) -> PriorVolumes:
    """V_coarse, M_rho, V_sharp and V_prior of slices in the poses that they have.

    Args:
        network: trained.
        slices: posed.
        voxel_mm: that the network was trained on.
        n_views: see `estimate_prior`.
    """
    from g3r.prior.inference import estimate_prior

    seconds: dict[str, float] = {}
    grid = grid_around(slices, voxel_mm, margin_mm=MARGIN_MM)
    coarse, density = _timed(seconds, "V_coarse", lambda: coarse_and_density(slices, grid))
    sharp = _timed(seconds, "V_sharp", lambda: sharpened_volume(slices, grid, coarse))
    scale = np.float32(normalisation_scale(coarse, density))
    given = coarse / scale, density, sharp / scale
    prior = _timed(seconds, "V_prior", lambda: estimate_prior(network, *given, n_views=n_views))
    by_name = {"V_coarse": coarse / scale, "V_sharp": sharp / scale, "V_prior": prior}
    return PriorVolumes(by_name, density, grid, seconds)


def tiling_difference(network: DensityGatedPriorNetwork, volumes: PriorVolumes, tile_voxels: int) -> float:
    """Largest difference, in the normalised scale, between a prior of one view made whole and in tiles."""
    from g3r.prior.inference import Tiling, estimate_prior

    given = volumes.by_name["V_coarse"], volumes.density, volumes.by_name["V_sharp"]
    tiled = estimate_prior(network, *given, tiling=Tiling(0, tile_voxels))
    return float(np.abs(tiled - volumes.by_name["V_prior"]).max())


def aligned_scores(
    data: NDArray[np.float32], grid: VolumeGrid, case: SimulatedCase, truth_from_volume: RigidPose
) -> Scores:
    """Scores of a volume after the rigid motion that fits it best to the truth.

    `g3r-evaluate --align` searches from anywhere, which takes up to half a minute. Here the poses of the
    slices tell the motion to a fraction of a millimetre, and Gauss-Newton steps do the rest in a second.

    Args:
        data: [I, J, K].
        grid: of the data.
        case: with the truth.
        truth_from_volume: where to begin: the common motion of the slices' pose error.
    """
    moved = refined_pose(data, grid, case.truth, case.truth_mask, truth_from_volume)
    return compare(Volume(data, _moved(moved, grid.affine), case.name), case.truth, case.truth_mask).scores


def figures(scores: Scores) -> dict[str, float]:
    """What the tables show of scores, as plain numbers."""
    return {"psnr_db": round(scores.psnr_db, 4), "ssim": round(scores.ssim, 5)}


def file_digest(path: Path) -> str:
    """The first 16 digits of a file's SHA-256: which weights a record was made with."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _moved(pose: RigidPose, affine: NDArray[np.float64]) -> NDArray[np.float64]:
    """An affine whose world is moved by one pose."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.rotation[0], pose.translation_mm[0]
    return matrix @ affine


def refined_pose(
    data: NDArray[np.float32], grid: VolumeGrid, truth: Volume, mask: NDArray[np.bool_], truth_from_volume: RigidPose
) -> RigidPose:
    """Least squares over six parameters, gain and offset, by Gauss-Newton from a near start."""
    inside = np.argwhere(mask)
    inside = inside[:: max(1, len(inside) // ALIGNMENT_POINTS)]
    wanted = truth.data[tuple(inside.T)].astype(np.float64)
    points_mm = truth.grid.world(inside)
    middle_mm = points_mm.mean(0)
    spline = spline_filter(data, order=3, output=np.float32)
    world_gradient = np.linalg.inv(grid.affine[:3, :3]).T
    slopes = [np.ascontiguousarray(slope, dtype=np.float32) for slope in np.gradient(data)]
    pose = truth_from_volume
    for _ in range(ALIGNMENT_STEPS):
        back = pose.inverse()
        index = grid.index(back.apply(points_mm[None])[0]).T
        value = map_coordinates(spline, index, order=3, prefilter=False).astype(np.float64)
        slope = np.stack([map_coordinates(one, index, order=1) for one in slopes], 1) @ world_gradient.T
        # the volume moves by (turn, shift) in the truth's world: its value at a point falls along
        slope = -(slope @ pose.rotation[0].T)
        lever = points_mm - middle_mm
        jacobian = np.concatenate([np.cross(lever, slope), slope], 1)
        gain, offset = np.polyfit(value, wanted, 1)
        system = np.concatenate([gain * jacobian, value[:, None], np.ones((len(value), 1))], 1)
        step = np.linalg.lstsq(system.T @ system, system.T @ (wanted - gain * value - offset), rcond=None)[0][:6]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        pose = RigidPose(turn[None], (step[3:] + middle_mm - turn @ middle_mm)[None]) @ pose
        if np.abs(step).max() < SMALL_STEP:
            break
    return pose


def _timed(seconds: dict[str, float], name: str, call: Callable[[], Any]) -> Any:
    start = time.perf_counter()
    result = call()
    seconds[name] = time.perf_counter() - start
    return result
