"""All backends of g3r that render and differentiate a cloud, under one signature."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from g3r.acquisition.planes import Planes
from g3r.fitting.objective import CloudObjective, ImageTerm
from g3r.fitting.parameters import FitParameters, LearningRates
from g3r.fitting.plane_state import PlaneState
from g3r.gaussians import GaussianCloud
from g3r.gaussians.amplitudes import AmplitudeSystem
from tests.numerics.errors import FULL_CUTOFF, gradients
from tests.numerics.scenes import single

Evaluated = tuple[Tensor, dict[str, Tensor]]


def reference64(cloud: GaussianCloud, planes: Planes, weight: Tensor) -> Evaluated:
    return gradients(cloud, planes, weight, torch.float64, backend="reference")


def reference32(cloud: GaussianCloud, planes: Planes, weight: Tensor) -> Evaluated:
    return gradients(cloud, planes, weight, torch.float32, backend="reference")


def numba(cloud: GaussianCloud, planes: Planes, weight: Tensor) -> Evaluated:
    return gradients(cloud, planes, weight, torch.float32, cutoff_sigma=FULL_CUTOFF)


def objective(cloud: GaussianCloud, planes: Planes, weight: Tensor) -> Evaluated:
    """The kernel of the fits: with targets far away on one side, L1 is a weighted sum plus a constant."""
    sign, size = weight.sign().numpy(), weight.abs().numpy()
    far = 10 * float(cloud.amplitude.abs().sum()) + 1
    parameters = FitParameters(single(cloud), LearningRates())
    term = ImageTerm.of(
        planes, (-far * sign).astype(np.float32), size.astype(np.float32), with_pose=True, cutoff_sigma=FULL_CUTOFF
    )
    step = CloudObjective(parameters, 0.0).begin({"image": (term, PlaneState.of(planes, cloud.origin_mm))})
    image = step.add("image", 1.0)
    step.finish()
    total = float(size.astype(np.float32).astype(float).sum())
    one = {name: torch.from_numpy(g.astype(float)) * total for name, g in parameters.gradient.items()}
    plane = torch.from_numpy(image.plane_gradient) * total
    assert np.isfinite(image.mean)
    return torch.zeros(0), {
        "centre": one["mean_mm"],
        "shape": torch.cat([one["log_scale"], one["quaternion_wxyz"]], 1),
        "amplitude": one["amplitude"],
        "turn": plane[:, :3],
        "shift": plane[:, 3:6],
        "gain": plane[:, 6:],
    }


def amplitudes(cloud: GaussianCloud, planes: Planes, weight: Tensor) -> Evaluated:
    """The linear system of the amplitudes and its adjoint."""
    system = AmplitudeSystem(single(cloud), planes, cutoff_sigma=FULL_CUTOFF)
    pixels = torch.from_numpy(system.forward(cloud.amplitude.numpy())).double()
    return pixels, {"amplitude": torch.from_numpy(system.adjoint(weight.numpy().astype(np.float32)))}


BACKENDS: dict[str, Callable[[GaussianCloud, Planes, Tensor], Evaluated]] = {
    "reference64": reference64,
    "reference32": reference32,
    "numba": numba,
    "objective": objective,
    "amplitudes": amplitudes,
}
FAST = ("numba", "objective", "amplitudes")
