"""Poses, gains and bias fields of the slices as parameters of a fit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.acquisition.bias_basis import N_TERMS
from g3r.acquisition.orientations import mean_normals
from g3r.acquisition.planes import Slices
from g3r.fitting.bias_field import StackBiasField
from g3r.fitting.objective import TermLoss
from g3r.fitting.open_shear import OpenShear
from g3r.fitting.parameters import Block, FitParameters, LearningRates
from g3r.fitting.plane_state import PlaneState
from g3r.geometry.rigid import right_jacobian
from g3r.registration.open_strain import open_strain


def slice_blocks(
    slices: Slices,
    gain: NDArray[np.float64],
    bias_field: StackBiasField | None,
    rates: LearningRates,
    optimise_poses: bool,
) -> dict[str, Block]:
    """Parameters fitted along with the cloud: start values and step sizes, by name.

    Args:
        slices: K slices.
        gain: [K] intensity factors at the start.
        bias_field: fields of the stacks; None where they are not fitted.
        rates: step sizes.
        optimise_poses: whether slices move.
    """
    n = len(slices)
    blocks: dict[str, Block] = {}
    if optimise_poses:
        blocks["rotation"] = np.zeros((n, 3)), rates.rotation_rad
        blocks["translation"] = np.zeros((n, 3)), rates.translation_mm
        if open_strain(mean_normals(slices)) is not None:
            blocks["shear"] = np.zeros(1), rates.shear
    if n > 1:  # the gain of a single slice cannot be separated from the amplitudes
        blocks["log_gain"] = np.log(gain), rates.log_gain
    if bias_field:
        blocks["bias_field"] = np.zeros((len(bias_field.stacks), N_TERMS)), rates.bias_field
    return blocks


class SliceParameters:
    """The state of the slices at the present parameters, and the gradients back.

    Blocks: rotation [K, 3] (rad) and translation [K, 3] (mm), R <- R exp(rotation), t <- t + translation;
    log_gain [K], whose mean is subtracted; bias_field [n_stacks, 5]; shear [1], zero between steps (`OpenShear`).
    A quantity without a block stays constant.

    Args:
        slices: K slices.
        gain: [K] intensity factors, used where there is no block of gains.
        parameters: of the fit.
    """

    def __init__(self, slices: Slices, gain: NDArray[np.float64], parameters: FitParameters) -> None:
        self.parameters, self.gain = parameters, gain.astype(np.float64)
        self.open_shear = OpenShear.of(slices, parameters.origin_mm) if "shear" in parameters.value else None
        self.start = PlaneState.of(slices.planes, parameters.origin_mm)
        _, self.stack = np.unique(slices.stack_id, return_inverse=True)
        corner_mm = np.sqrt(((slices.planes.shape * slices.planes.spacing_mm / 2) ** 2).sum(1))
        self.radius_mm = float(corner_mm.mean()) / 2

    @property
    def with_pose(self) -> bool:
        """Whether slices move."""
        return "rotation" in self.parameters.value

    def _motion(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        value = self.parameters.value
        return value["rotation"].astype(np.float64), value["translation"].astype(np.float64)

    def state(self, slice_weight: NDArray[np.float64]) -> PlaneState:
        """Planes, gains and fields at the present parameters, with slice weights [K]."""
        value, start = self.parameters.value, self.start
        orientation, center_mm, gain, coefficients = start.rotation, start.center_mm, self.gain, start.coefficients
        if self.with_pose:
            rotation, translation = self._motion()
            orientation = orientation @ Rotation.from_rotvec(rotation).as_matrix()
            center_mm = center_mm + translation
        if "log_gain" in value:
            log_gain = value["log_gain"].astype(np.float64)
            gain = np.exp(log_gain - log_gain.mean())
        if "bias_field" in value:
            coefficients = value["bias_field"][self.stack]
        return PlaneState(
            rotation=orientation, center_mm=center_mm, gain=gain, slice_weight=slice_weight, coefficients=coefficients
        )

    def finish(self, image: TermLoss, pose_prior_mm: float, bias_field_ridge: float) -> float:
        """Write the gradients of poses, gains and fields; returns the loss terms of these alone.

        Args:
            image: the slices' image term. Its mean scales the pose prior, which is that mean times the mean square
                movement of a slice over pose_prior_mm^2.
            pose_prior_mm: movement at which the pose prior of a slice equals the image term.
            bias_field_ridge: weight of the mean squared coefficient of the fields.
        """
        value, gradient = self.parameters.value, self.parameters.gradient
        loss = 0.0
        if self.with_pose:
            rotation, translation = self._motion()
            radius2, n = self.radius_mm**2, max(1, len(rotation))
            loss += image.mean * (np.sum(translation**2) + radius2 * np.sum(rotation**2)) / n / pose_prior_mm**2
            pull = 2 * image.mean / n / pose_prior_mm**2
            # the kernels differentiate by a rotation after the present one
            after = np.einsum("kji,kj->ki", right_jacobian(rotation), image.plane_gradient[:, :3])
            gradient["rotation"][...] = after + pull * radius2 * rotation
            gradient["translation"][...] = image.plane_gradient[:, 3:6] + pull * translation
            if self.open_shear is not None:  # last, since it follows from the gradients of all that moves by it
                gradient["shear"][0] = self.open_shear.slope(self.parameters)
        if "log_gain" in value:
            slope = image.plane_gradient[image.chosen, 6]  # only slices that were seen have a known mean
            gradient["log_gain"][...] = 0.0
            gradient["log_gain"][image.chosen] = slope - slope.mean()
        if "bias_field" in value:
            c = value["bias_field"].astype(np.float64)
            total = np.zeros_like(c)
            np.add.at(total, self.stack, image.field_gradient)
            loss += bias_field_ridge * float(np.mean(c**2))
            gradient["bias_field"][...] = total + 2 * bias_field_ridge / c.size * c
        return loss

    def fold(self) -> None:
        """Apply the shear of the last step to Gaussians and slices."""
        if self.open_shear is not None:
            self.open_shear.fold(self.parameters)
