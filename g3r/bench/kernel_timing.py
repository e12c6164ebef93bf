"""Seconds of the renderer's passes and of an optimiser step, and the limits of one core."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import torch

from g3r.bench.scenes import evaluations, head_scene
from g3r.fitting import kernels as fit_kernels
from g3r.fitting.objective import CloudObjective, ImageTerm
from g3r.fitting.parameters import FitParameters, LearningRates
from g3r.fitting.slice_parameters import SliceParameters, slice_blocks
from g3r.gaussians import GaussianCloud, find_overlaps, kernels, kernels_backward, render
from g3r.gaussians.arrays import CloudArrays, PlaneArrays, Workspace
from g3r.gaussians.render import CUTOFF_SIGMA

CLOCK = time.thread_time
STEP_FACTOR = 0.1
"""Factor on the step sizes of timed steps, as near the end of a fit."""

STEPS = 10


f32 = np.float32

COPY_BYTES = 2**27
"""Larger than any cache."""

N_IN_CACHE, N_TURNS, N_FUSED = 2048, 2000, 64
"""Numbers that fit into the innermost cache, rounds over them, and operations on each number in a round."""


def best_seconds(call: Callable[[], object], repeats: int, clock: Callable[[], float]) -> float:
    """Least time of several calls, after one unmeasured call.

    Args:
        call: call to time.
        repeats: number of timed calls.
        clock: seconds since any fixed moment.
    """
    call()
    seconds = []
    for _ in range(repeats):
        start = clock()
        call()
        seconds.append(clock() - start)
    return min(seconds)


@numba.njit(nogil=True, cache=True)
def _copy(source, target):
    for i in range(len(source)):
        target[i] = source[i]


@numba.njit(nogil=True, cache=True, fastmath={"contract"})
def _fused(values, turns, a, b, c, d):
    """Four chains of sixteen fused multiply-adds on each value, independent of each other."""
    total = f32(0.0)
    for _ in range(turns):
        for i in range(len(values)):
            x = values[i]
            p, q, r, s = x, x, x, x
            for _ in range(16):
                p = p * x + a
                q = q * x + b
                r = r * x + c
                s = s * x + d
            values[i] = (p + q) + (r + s)
        total += values[0]
        values[:] = f32(0.5)
    return total


def copy_bytes_per_second(repeats: int = 5) -> float:
    """Bytes read and written per second by one core."""
    source, target = np.ones(COPY_BYTES // 4, np.float32), np.zeros(COPY_BYTES // 4, np.float32)
    return 2 * COPY_BYTES / best_seconds(lambda: _copy(source, target), repeats, time.thread_time)


def fused_per_second(repeats: int = 5) -> float:
    """Fused multiply-adds (of one number each) per second by one core."""
    values = np.full(N_IN_CACHE, 0.5, np.float32)
    small = [f32(x) for x in (0.1, 0.2, 0.3, 0.4)]
    seconds = best_seconds(lambda: _fused(values, N_TURNS, *small), repeats, time.thread_time)
    return N_IN_CACHE * N_TURNS * N_FUSED / seconds


def numba_rates(n_gaussians: int, repeats: int) -> dict[str, float]:
    """Pairs, pixels inside the cut-off, and seconds of one forward and one backward pass."""
    scene = head_scene(n_gaussians)
    cloud, planes = scene.cloud, scene.slices.planes
    overlaps = find_overlaps(cloud, planes, CUTOFF_SIGMA)
    n_pixels, n_pairs = evaluations(cloud, planes, CUTOFF_SIGMA)
    out = np.zeros(planes.n_pixels, np.float32)
    buffers = np.zeros((1, n_gaussians, kernels.N_GRADIENTS))
    plane_gradient = np.zeros((len(planes), kernels.N_PLANE_GRADIENTS))
    described = PlaneArrays.of(planes, cloud.origin_mm)
    work = Workspace.of(planes, overlaps.most)
    common = (CloudArrays.of(cloud), described, overlaps.arrays, CUTOFF_SIGMA**2, True, work)

    def forward() -> None:
        kernels.forward(*common, out)

    def backward() -> None:
        kernels_backward.backward(*common, out, buffers, plane_gradient)

    return {
        "n_pairs": n_pairs,
        "n_pixels": n_pixels,
        "forward_seconds": best_seconds(forward, repeats, CLOCK),
        "backward_seconds": best_seconds(backward, repeats, CLOCK),
    }


def reference_rates(n_gaussians: int, n_slices: int, repeats: int) -> dict[str, float]:
    """Time one pass of the dense torch reference, which has no cut-off, so every pair has every pixel.

    Args:
        n_gaussians: Gaussians in the scene.
        n_slices: slices of each stack.
        repeats: number of passes, at most three, of which the fastest counts.
    """
    scene = head_scene(n_gaussians, n_slices)
    leaves = [p.clone().requires_grad_() for p in scene.cloud.parameters]
    cloud = GaussianCloud.of(leaves, scene.cloud.origin_mm)
    planes, n_threads = scene.slices.planes, torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        forward, backward = [], []
        for _ in range(min(repeats, 3)):
            start = CLOCK()
            pixels = render(cloud, planes, backend="reference")
            middle = CLOCK()
            pixels.sum().backward()
            forward.append(middle - start)
            backward.append(CLOCK() - middle)
    finally:
        torch.set_num_threads(n_threads)
    n_pixels = n_gaussians * planes.n_pixels
    return {
        "n_pairs": n_gaussians * len(planes),
        "n_pixels": n_pixels,
        "forward_seconds": min(forward),
        "backward_seconds": min(backward),
    }


def step_seconds(n_gaussians: int, repeats: int) -> dict[str, float]:
    """Time of an optimiser step of the slice stage, its ratio to two kernel calls, and its share outside its kernel.

    The step has poses, gains and the scale regulariser; the two calls are `forward` and `backward` on the
    pairs that the step uses.
    """
    scene = head_scene(n_gaussians)
    slices, ones = scene.slices, np.ones(len(scene.slices))
    rates = LearningRates()
    parameters = FitParameters(scene.cloud, rates, slice_blocks(slices, ones, None, rates, optimise_poses=True))
    unknowns = SliceParameters(slices, ones, parameters)
    term = ImageTerm.of(slices.planes, slices.value, slices.mask.astype(np.float32), with_pose=True)
    objective = CloudObjective(parameters, 0.02)
    inside = [0.0]
    plain: Any = fit_kernels.image_l1

    def timed(*arguments: object) -> None:
        start = CLOCK()
        plain(*arguments)
        inside[0] += CLOCK() - start

    def step() -> None:
        loss = objective.begin({"slices": (term, unknowns.state(ones))})
        image = loss.add("slices", 1.0)
        parameters.step(image.mean + loss.finish() + unknowns.finish(image, 10.0, 0.0), STEP_FACTOR)

    setattr(fit_kernels, plain.__name__, timed)
    try:
        step()
        totals, shares = [], []
        for _ in range(repeats):
            inside[0], start = 0.0, CLOCK()
            for _ in range(STEPS):
                step()
            totals.append((CLOCK() - start) / STEPS)
            shares.append(1 - inside[0] / STEPS / totals[-1])
    finally:
        setattr(fit_kernels, plain.__name__, plain)
    calls = numba_rates(n_gaussians, repeats)
    both = calls["forward_seconds"] + calls["backward_seconds"]
    return {
        "step_seconds": min(totals),
        "step_over_kernels": min(totals) / both,
        "not_kernel_share": float(np.median(shares)),
    }
