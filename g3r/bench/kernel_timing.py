"""Seconds of the renderer's passes and of an optimiser step, for `g3r-bench kernels`."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch

from g3r.bench.kernel_rates import best_seconds
from g3r.bench.kernel_scene import count_pixels, head_scene, record_space
from g3r.fitting import kernels as fit_kernels
from g3r.fitting.objective import CloudObjective, ImageTerm
from g3r.fitting.parameters import FitParameters, LearningRates
from g3r.fitting.slice_term import SliceTerm
from g3r.gaussians import GaussianCloud, find_overlaps, kernels, kernels_backward, render
from g3r.gaussians.overlap import CloudArrays, Workspace
from g3r.gaussians.render import CUTOFF_SIGMA, plane_arguments

CLOCK = time.thread_time
STEP_FACTOR = 0.1
"""Of the step sizes while steps are timed, as near the end of a fit."""

STEPS = 10


def numba_rates(n_gaussians: int, repeats: int) -> dict[str, float]:
    """Pairs, pixels inside the cut-off, and seconds of one forward and one backward pass."""
    scene = head_scene(n_gaussians)
    planes, arrays = scene.slices.planes, CloudArrays.of(scene.cloud)
    pairs = find_overlaps(scene.cloud, planes, CUTOFF_SIGMA)
    described: Any = plane_arguments(planes, planes.center_mm, np.ones(len(planes)), pairs)
    work, cut = Workspace.of(planes, pairs.most), CUTOFF_SIGMA**2
    n_pixels, n_pairs = count_pixels(arrays.shapes, *described, cut, record_space(pairs.most))  # type: ignore[call-arg]
    out = np.zeros(planes.n_pixels, np.float32)
    buffers = np.zeros((1, n_gaussians, kernels.N_GRADIENTS))
    plane_gradient = np.zeros((len(planes), kernels.N_PLANE_GRADIENTS))
    common = (arrays.shapes, arrays.amplitude, *described, cut, True, work.images, work.projections)

    def forward() -> None:
        kernels.forward(*common, out)  # type: ignore[call-arg]

    def backward() -> None:
        kernels_backward.backward(*common, out, buffers, plane_gradient)  # type: ignore[call-arg]

    return {
        "n_pairs": int(n_pairs),
        "n_pixels": int(n_pixels),
        "forward_seconds": best_seconds(forward, repeats, CLOCK),
        "backward_seconds": best_seconds(backward, repeats, CLOCK),
    }


def reference_rates(n_gaussians: int, n_slices: int, repeats: int) -> dict[str, float]:
    """The same of the dense reference in torch, which has no cut-off: every pair has every pixel."""
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
    """A whole optimiser step of the slice stage over the two kernel calls, and the share outside its kernel.

    The step has poses, gains and the scale regulariser; the two calls are `forward` and `backward` on the
    pairs that the step uses.
    """
    scene = head_scene(n_gaussians)
    slices, n = scene.slices, len(scene.slices)
    further = {"turn": (np.zeros((n, 3)), 1e-3), "shift": (np.zeros((n, 3)), 0.03), "log_gain": (np.zeros(n), 2e-3)}
    parameters = FitParameters(scene.cloud, LearningRates(), further)
    term = SliceTerm(slices, np.ones(n), np.ones(n), parameters)
    terms: list[ImageTerm] = [term]
    objective = CloudObjective(parameters, terms, 0.02)
    inside = [0.0]
    plain: Any = fit_kernels.image_l1

    def timed(*arguments: object) -> None:
        start = CLOCK()
        plain(*arguments)
        inside[0] += CLOCK() - start

    def step() -> None:
        term.update()
        objective.begin()
        image = objective.add(term, 1.0)
        parameters.step(image + objective.finish() + term.finish(image, 10.0, 0.0), STEP_FACTOR)

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
