"""Stack-to-stack registration: one stack after the other, from many starts.

A volume is made of the stacks registered so far. The next stack is tried in many rotations about the centre of the
head, the best few are refined by Gauss-Newton with the whole stack as one rigid body, and the best one is taken. Stacks
are added one by one, because the mean of unregistered stacks is a blur that draws all of them to its centre.
"""

from __future__ import annotations

import itertools
import logging

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.least_squares import solve_volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.robust import robust_width
from g3r.acquisition.thinning import thinned
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import RigidPose
from g3r.geometry.rigid import rotation_matrix, skew
from g3r.registration.normal_equations import SampledSlices
from g3r.registration.similarity import correlation

logger = logging.getLogger(__name__)

SEARCH_ANGLES_DEG = (-24.0, 0.0, 24.0)
SEARCH_VOXEL_MM = 3.2
N_REFINED = 4
MAX_ROTATION_RAD, MAX_TRANSLATION_MM = 0.12, 4.0
"""Trust region of one Gauss-Newton step of a stack."""


def register_stacks(slices: Slices) -> Slices:
    """Bring all stacks into the frame of the most self-consistent one.

    Args:
        slices: slices of all stacks at their header poses, normalised.
    """
    stacks = np.unique(slices.stack_id)
    if len(stacks) == 1:
        return slices
    order = sorted(stacks, key=lambda s: -self_consistency(slices.take(slices.stack_id == s)))
    done = [order[0]]
    for stack in order[1:]:
        moving = slices.stack_id == stack
        fixed_slices = slices.take(np.isin(slices.stack_id, done))
        pose, ncc = _register_one(slices.take(moving), fixed_slices)
        slices = slices.with_pose(slices.planes.pose.with_rows(moving, pose))
        done.append(stack)
        logger.debug("stack %d registered, correlation %.3f", stack, ncc)
    return slices


def self_consistency(stack: Slices) -> float:
    """Mean correlation of neighbouring slices of a stack, in [-1, 1]; high where the fetus kept still.

    Every slice is compared with its neighbour by the header through a nearest-pixel look-up.
    """
    values = []
    planes = stack.planes
    for a, b in itertools.pairwise(range(len(stack))):
        points = planes.take([a]).pixel_world_mm()
        mask = stack.mask[planes.offset[a] : planes.offset[a + 1]]
        local = (points[mask] - planes.center_mm[b]) @ planes.rotation[b][:, :2]
        index = np.rint(local / planes.spacing_mm[b] + (planes.shape[b] - 1) / 2).astype(int)
        inside = ((index >= 0) & (index < planes.shape[b])).all(1)
        pixel = planes.offset[b] + index[inside, 0] * planes.shape[b, 1] + index[inside, 1]
        shared = stack.mask[pixel]
        x = stack.value[planes.offset[a] : planes.offset[a + 1]][mask][inside][shared]
        y = stack.value[pixel[shared]]
        if len(x) > 20 and x.std() > 0 and y.std() > 0:
            values.append(np.corrcoef(x, y)[0, 1])
    return float(np.mean(values)) if values else -1.0


def _register_one(moving: Slices, fixed: Slices) -> tuple[RigidPose, float]:
    grid = grid_around(fixed, SEARCH_VOXEL_MM, margin_mm=20.0)
    index = fixed.pixel_index[thinned(len(fixed.pixel_index), 120_000)]
    operator = VoxelOperator(fixed.planes, grid, index, (1, 1, 5))
    volume = solve_volume(operator, fixed.value[index], np.ones(len(index), np.float32), smoothness=0.1)
    volume = gaussian_filter(volume, 0.8)
    coarse = SampledSlices(moving, volume, grid, n_pixels=15_000, psf_points=3)
    moving_center, fixed_center = _centroid(moving), _centroid(fixed)
    starts = []
    for angles in itertools.product(SEARCH_ANGLES_DEG, repeat=3):
        rotation = rotation_matrix(np.deg2rad(angles))
        # about the centre of the head, which is moved to the centre of the other stacks or left at its header position
        for target in (fixed_center, moving_center):
            motion = RigidPose(rotation[None], (target - rotation @ moving_center)[None])
            pose = motion @ moving.planes.pose
            starts.append((_agreement(coarse, moving, pose), pose))
    starts.sort(key=lambda item: -item[0])
    fine = SampledSlices(moving, volume, grid, n_pixels=45_000, psf_points=3)
    refined = []
    for _, pose in starts[:N_REFINED]:
        pose = refine_stack(coarse, moving, pose, n_steps=8)
        pose = refine_stack(fine, moving, pose, n_steps=6)
        refined.append((_agreement(fine, moving, pose), pose))
    ncc, pose = max(refined, key=lambda item: item[0])
    return pose, float(ncc)


def _centroid(slices: Slices) -> NDArray[np.float64]:
    return slices.planes.pixel_world_mm(slices.pixel_index).mean(0)


def _agreement(model: SampledSlices, slices: Slices, pose: RigidPose) -> float:
    """Correlation over all pixels of a stack."""
    equations = model.evaluate(slices.planes.with_pose(pose), np.ones(len(slices)), 1.0)
    return float(correlation(equations.moments.sum(0)))


def refine_stack(model: SampledSlices, slices: Slices, pose: RigidPose, n_steps: int) -> RigidPose:
    """Levenberg-Marquardt on one rigid motion of a whole stack.

    A world twist (W, V) about the centre c moves slice k in its own frame by w = R^T W and
    v = R^T (W x (t - c) + V); its normal matrix is the sum of those of the slices in these terms.

    Args:
        model: the pixels of the stack and the volume.
        slices: K slices of the stack.
        pose: [K] world from plane, to start from.
        n_steps: number of evaluations.
    """
    gain = np.ones(len(slices))
    damping = 1e-2
    center = pose.translation_mm.mean(0)
    width = robust_width(model.residuals(slices.planes.with_pose(pose), gain), n_sigma=2)
    current = model.evaluate(slices.planes.with_pose(pose), gain, width)
    size = current.moments[:, 0]
    for _ in range(n_steps):
        transfer = _stack_transfer(pose, center)
        hessian = np.einsum("kai,kab,kbj->ij", transfer, current.hessian[:, :6, :6], transfer)
        gradient = np.einsum("kai,ka->i", transfer, current.gradient[:, :6])
        scale = np.diag(hessian) + 1e-12 * np.trace(hessian)
        if not scale.min() > 0:
            break
        twist = np.linalg.solve(hessian + np.diag(damping * scale), gradient)
        twist[:3] = _shortened(twist[:3], MAX_ROTATION_RAD)
        twist[3:] = _shortened(twist[3:], MAX_TRANSLATION_MM)
        rotation = rotation_matrix(twist[:3])
        trial_pose = RigidPose(rotation[None], (center - rotation @ center + twist[3:])[None]) @ pose
        trial = model.evaluate(slices.planes.with_pose(trial_pose), gain, width)
        if size @ trial.loss < size @ current.loss:
            pose, current, damping = trial_pose, trial, max(damping / 3, 1e-4)
        else:
            damping *= 8
    return pose


def _stack_transfer(pose: RigidPose, center: NDArray[np.float64]) -> NDArray[np.float64]:
    transposed = pose.rotation.transpose(0, 2, 1)
    transfer = np.zeros((len(pose), 6, 6))
    transfer[:, :3, :3] = transposed
    transfer[:, 3:, :3] = -transposed @ skew(pose.translation_mm - center)
    transfer[:, 3:, 3:] = transposed
    return transfer


def _shortened(vector: NDArray[np.float64], longest: float) -> NDArray[np.float64]:
    length = float(np.linalg.norm(vector))
    return vector * (longest / length) if length > longest else vector
