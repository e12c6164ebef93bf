"""The slices in the loss: their pixels under poses, gains and shadings that are parameters too."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes, Slices
from g3r.acquisition.robust import slice_weights
from g3r.fitting.bias_field import StackBiasField
from g3r.fitting.objective import TINY, ImageTerm
from g3r.fitting.parameters import FitParameters
from g3r.gaussians.render import CUTOFF_SIGMA, right_jacobian
from g3r.geometry import RigidPose


class SliceTerm(ImageTerm):
    """L1 of the slices with what is fitted along, as far as `parameters` has blocks for it.

    Blocks: turn [K, 3] (rad) and shift [K, 3] (mm), R <- R exp(turn), t <- t + shift; log_gain [K], of which
    the mean is taken off; shading [n_stacks, 5]. What has no block stays as it is.

    Args:
        slices: K slices.
        gain: [K] intensity factors.
        weight: [K] trust.
        parameters: of the fit.
        bias_field: fields of the stacks; None where there are none.
        exact: the amplitude, as in `render`.
        cutoff_sigma: where a Gaussian ends.
    """

    def __init__(
        self,
        slices: Slices,
        gain: NDArray[np.float64],
        weight: NDArray[np.float64],
        parameters: FitParameters,
        bias_field: StackBiasField | None = None,
        exact: bool = True,
        cutoff_sigma: float = CUTOFF_SIGMA,
    ) -> None:
        super().__init__(
            slices.planes,
            slices.value,
            slices.mask.astype(np.float32),
            parameters.origin_mm,
            basis=bias_field.basis if bias_field else None,
            with_pose="turn" in parameters.value,
            exact=exact,
            cutoff_sigma=cutoff_sigma,
        )
        self.parameters = parameters
        self.gain, self.slice_weight = gain.astype(np.float64), weight.astype(np.float64)
        self.start_center_mm = self.center_mm
        _, self.stack = np.unique(slices.stack_id, return_inverse=True)
        corner_mm = np.sqrt(((self.planes.shape * self.planes.spacing_mm / 2) ** 2).sum(1))
        self.radius_mm = float(corner_mm.mean()) / 2
        far = [
            np.linalg.norm(points, axis=1).max(initial=0.0) for points in (parameters.value["mean_mm"], self.center_mm)
        ]
        # of a Gaussian from a plane's centre: what a turn moves it by, over its angle
        self.reach_mm = float(sum(far))

    def update(self) -> None:
        """Bring planes, gains and fields to the present parameters."""
        value = self.parameters.value
        if self.with_pose:
            turn, shift = value["turn"].astype(np.float64), value["shift"].astype(np.float64)
            self.rotation = self.planes.rotation @ Rotation.from_rotvec(turn).as_matrix()
            self.center_mm = self.start_center_mm + shift
            if self.pairs is not None:
                # the angle between two rotations is at most the distance of their rotation vectors
                turned, shifted = (np.linalg.norm(a - b, axis=1) for a, b in zip((turn, shift), self.then, strict=True))
                self.moved_mm = float((shifted + turned * self.reach_mm).max(initial=0.0))
        if "log_gain" in value:
            log_gain = value["log_gain"].astype(np.float64)
            self.gain = np.exp(log_gain - log_gain.mean())
        if "shading" in value:
            self.coefficients = value["shading"][self.stack]

    def find_overlaps(self, shapes: NDArray[np.float64]) -> None:
        """As `ImageTerm.find_overlaps`; movement is measured from here on."""
        super().find_overlaps(shapes)
        if self.with_pose:
            self.then = [self.parameters.value[name].astype(np.float64) for name in ("turn", "shift")]
            self.moved_mm = 0.0

    def finish(self, image: float, pose_prior_mm: float, bias_field_ridge: float) -> float:
        """Write the gradients of poses, gains and fields after `add`; returns the terms of those alone.

        Args:
            image: this term's value, which scales the pose prior: image times the mean square movement of a
                slice over pose_prior_mm^2.
            pose_prior_mm: a slice that moves this far pays as much as a change of the image term by its own
                size would.
            bias_field_ridge: weight of the mean squared coefficient of the fields.
        """
        value, gradient = self.parameters.value, self.parameters.gradient
        loss = 0.0
        if self.with_pose:
            turn, shift = value["turn"].astype(np.float64), value["shift"].astype(np.float64)
            radius2, n = self.radius_mm**2, max(1, len(turn))
            loss += image * (np.sum(shift**2) + radius2 * np.sum(turn**2)) / n / pose_prior_mm**2
            pull = 2 * image / n / pose_prior_mm**2
            # the kernels differentiate in a turn on top of the present one
            on_top = np.einsum("kji,kj->ki", right_jacobian(turn), self.plane_gradient[:, :3])
            gradient["turn"][...] = on_top + pull * radius2 * turn
            gradient["shift"][...] = self.plane_gradient[:, 3:6] + pull * shift
        if "log_gain" in value:
            slope = self.plane_gradient[:, 6]
            gradient["log_gain"][...] = slope - slope.mean()
        if "shading" in value:
            c = value["shading"].astype(np.float64)
            total = np.zeros_like(c)
            np.add.at(total, self.stack, self.field_gradient)
            loss += bias_field_ridge * float(np.mean(c**2))
            gradient["shading"][...] = total + 2 * bias_field_ridge / c.size * c
        return loss

    @property
    def mean_residual(self) -> float:
        """Mean absolute residual at the last `add` under the present trust."""
        return float(self.slice_weight @ self.residual) / max(float(self.slice_weight @ self.total), TINY)

    def reweight(self) -> None:
        """Trust in each slice from its mean absolute residual at the last `add`."""
        self.slice_weight = slice_weights(self.residual / np.maximum(self.total, 1)).astype(np.float32).astype(float)

    def moved_planes(self) -> Planes:
        """The slices' planes at the present poses."""
        return self.planes.with_pose(RigidPose(self.rotation, self.center_mm + self.origin_mm))
