"""The gradient of the complete slice-fitting loss against finite differences of the same loss in float64.

The loss is implemented here a second time, in float64 and without a gradient: pixels by the dense reference
renderer, then the terms of Eq. 9. No pixel lies near the kink of |residual|: targets are moved
away from the rendered values, so that central differences of 1e-5 stay on one side and are exact to 1e-8.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes, Slices
from g3r.fitting.bias_field import StackBiasField
from g3r.fitting.parameters import FitParameters
from g3r.fitting.prior_stage import VolumeTarget
from g3r.fitting.schedules import AnnealedWeight
from g3r.fitting.slice_parameters import slice_blocks
from g3r.fitting.slice_stage import SliceLoss, SliceStageSettings
from g3r.gaussians import GaussianCloud, render
from tests.numerics.scenes import head_scene, single
from tests.tally import Tally

CLOUD = ("mean_mm", "log_scale", "quaternion_wxyz", "amplitude")
STEP = 1e-5
SETTINGS = SliceStageSettings(
    scale_weight=0.3,
    bias_field_ridge=0.05,
    pose_prior_mm=2.0,
    cutoff_sigma=6.0,
    prior_error=0.05,
    distillation=AnnealedWeight(0.4, 0.1),
    distillation_planes=0.4,
    n_parts=1,
)
FRACTION = 0.5


class CompleteLoss:
    """Six Gaussians, six slices of three stacks and a prior; all parameters are fitted, and none is zero."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        scene = head_scene(np.zeros(3), 6, seed)
        cloud = single(scene.cloud)
        planes = scene.planes.take([4, 6, 14, 16, 24, 26])
        planes = replace(planes, shape=np.full((6, 2), 16), spacing_mm=np.full((6, 2), 1.4))
        mask = rng.uniform(size=planes.n_pixels) < 0.8
        slices = Slices(
            planes=planes,
            value=np.zeros(planes.n_pixels, np.float32),
            mask=mask,
            stack_id=np.repeat(np.arange(3), 2),
            slice_index=np.tile([0, 1], 3),
            thickness_mm=np.full(6, 2.2),
            header_pose=planes.pose,
        )
        self.gain, self.slice_weight = np.exp(rng.normal(0, 0.1, 6)), rng.uniform(0.2, 1, 6)
        self.bias_field = StackBiasField(slices)
        blocks = slice_blocks(slices, self.gain, self.bias_field, SETTINGS.rates, optimise_poses=True)
        self.parameters = FitParameters(cloud, SETTINGS.rates, blocks)
        self.seed = self.parameters.value["log_scale"].astype(float).copy()
        for name, size in {
            "mean_mm": 0.3,
            "log_scale": 0.2,
            "quaternion_wxyz": 0.2,
            "rotation": 0.1,
            "translation": 0.4,
            "log_gain": 0.2,
            "bias_field": 0.2,
        }.items():
            value = self.parameters.value[name]
            value += rng.normal(0, size, value.shape).astype(np.float32)
        self.prior = self._prior(rng)
        self.slices = slices
        away = rng.choice([-1, 1], planes.n_pixels) * rng.uniform(0.1, 0.4, planes.n_pixels)
        self.slices = replace(slices, value=(self._shown(self._values()) + away).astype(np.float32))
        self.draw_seed = seed
        self.loss = self.loss_with(SETTINGS)

    def loss_with(self, settings: SliceStageSettings) -> SliceLoss:
        """The loss at the current parameters with given settings."""
        loss = SliceLoss(
            self.parameters,
            self.slices,
            gain=self.gain,
            slice_weight=self.slice_weight,
            bias_field=self.bias_field,
            prior=self.prior,
            settings=settings,
        )
        loss.objective.seed_log_scale[...] = self.seed  # as in the middle of a fit
        loss.draw(np.random.default_rng(self.draw_seed))
        return loss

    def _values(self) -> dict[str, np.ndarray]:
        return {name: value.astype(float) for name, value in self.parameters.value.items()}

    def _cloud(self, value: dict[str, np.ndarray]) -> GaussianCloud:
        return GaussianCloud.of([torch.from_numpy(value[name]) for name in CLOUD], np.zeros(3))

    def _prior(self, rng: np.random.Generator) -> VolumeTarget:
        n = 6
        spacing = np.full((n, 2), 1.9)
        planes = Planes(
            rotation=np.tile(np.eye(3), (n, 1, 1)),
            center_mm=np.array([[0, 0, z] for z in np.linspace(-6, 6, n)]),
            spacing_mm=spacing,
            shape=np.full((n, 2), 11),
            psf_var_mm2=np.zeros((n, 3)),
        )
        shown = render(self._cloud(self._values()), planes, backend="reference").numpy()
        away = rng.choice([-1, 1], planes.n_pixels) * rng.uniform(0.1, 0.3, planes.n_pixels)
        weight = rng.uniform(0, 1, planes.n_pixels) * (rng.uniform(size=planes.n_pixels) < 0.7)
        return VolumeTarget(planes, (shown + away).astype(np.float32), weight.astype(np.float32))

    def _shown(self, value: dict[str, np.ndarray]) -> np.ndarray:
        planes = self.slices.planes
        turn = planes.rotation @ Rotation.from_rotvec(value["rotation"]).as_matrix()
        moved = replace(planes, rotation=turn, center_mm=planes.center_mm + value["translation"])
        pixels = render(self._cloud(value), moved, backend="reference").numpy()
        plane = planes.plane_id()
        gain = np.exp(value["log_gain"] - value["log_gain"].mean())[plane]
        field = (value["bias_field"][self.slices.stack_id[plane]] * self.bias_field.basis.T.astype(float)).sum(1)
        return pixels * gain * np.exp(field)

    def float64(self, value: dict[str, np.ndarray], frozen: float | None = None) -> float:
        """The loss; `frozen` is the image term where it serves as a weight without gradient."""
        weight = self.slices.mask * self.slice_weight[self.slices.planes.plane_id()]
        image = (weight * np.abs(self._shown(value) - self.slices.value)).sum() / weight.sum()
        frozen = image if frozen is None else frozen
        self.image = image
        chosen = self.prior.take(np.flatnonzero(self._is_chosen()))
        near = np.abs(render(self._cloud(value), chosen.planes, backend="reference").numpy() - chosen.value)
        distance = (chosen.weight * near).sum(dtype=float) / chosen.weight.sum(dtype=float)
        annealed = 0.4 + 0.5 * (0.1 - 0.4)  # half way between tau_1 = 0.2 and tau_2 = 0.8
        strength = max(annealed, min(frozen / SETTINGS.prior_error, 1.0))
        share = self.prior.weight[self.prior.weight > 0].mean(dtype=float)
        loss = image + strength * share * distance
        loss += SETTINGS.scale_weight * ((value["log_scale"] - self.seed) ** 2).mean()
        half = self.slices.planes.shape * self.slices.planes.spacing_mm / 2
        radius = np.sqrt((half**2).sum(1)).mean() / 2
        moved = (value["translation"] ** 2).sum(1) + radius**2 * (value["rotation"] ** 2).sum(1)
        loss += frozen * moved.mean() / SETTINGS.pose_prior_mm**2
        loss += SETTINGS.bias_field_ridge * (value["bias_field"] ** 2).mean()
        return float(loss)

    def _is_chosen(self) -> np.ndarray:
        drawn = self.loss.distilled.planes.center_mm[:, 2]
        return np.isin(self.prior.planes.center_mm[:, 2], drawn)

    def finite_differences(self) -> dict[str, np.ndarray]:
        value = self._values()
        self.float64(value)
        frozen, found = self.image, {}
        for name, array in value.items():
            slope = np.zeros(array.size)
            flat = array.reshape(-1)
            for i in range(array.size):
                start, ends = flat[i], []
                for sign in (1, -1):
                    flat[i] = start + sign * STEP
                    ends.append(self.float64(value, frozen))
                flat[i] = start
                slope[i] = (ends[0] - ends[1]) / (2 * STEP)
            found[name] = slope.reshape(array.shape)
        return found


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.numerics)])
def test_every_gradient_of_the_complete_loss_is_the_finite_difference(seed: int, tally: Tally) -> None:
    complete = CompleteLoss(seed)
    value, entry = complete.loss.evaluate(FRACTION)
    assert {"image", "distillation", "distillation_weight"} <= set(entry)
    assert value == pytest.approx(complete.float64(complete._values()), rel=1e-5)
    expected = complete.finite_differences()
    assert set(expected) == {*CLOUD, "rotation", "translation", "log_gain", "bias_field"}
    for name, exact in expected.items():
        with tally.case():
            found = complete.parameters.gradient[name].astype(float)
            assert np.linalg.norm(exact) > 1e-3, f"{name}: nothing to check"
            assert np.linalg.norm(found - exact) <= 1e-4 * np.linalg.norm(exact), name
            assert np.abs(found - exact).max() <= 1e-4 * np.abs(exact).max(), name


def test_a_wrong_term_would_be_seen(tally: Tally) -> None:
    """Omitting any term from the float64 loss changes some gradient by far more than the tolerance."""
    complete = CompleteLoss(0)
    complete.loss.evaluate(FRACTION)
    changes: dict[str, dict[str, Any]] = {
        "scale": {"scale_weight": 0.0},
        "poses": {"pose_prior_mm": 1e9},
        "bias field": {"bias_field_ridge": 0.0},
        "distillation": {"distillation": AnnealedWeight(0.0, 0.0)},
    }
    for name, change in changes.items():
        before = {n: g.copy() for n, g in complete.parameters.gradient.items()}
        complete.loss_with(replace(SETTINGS, **change)).evaluate(FRACTION)
        moved = [
            np.linalg.norm(g - before[n]) / np.linalg.norm(before[n]) for n, g in complete.parameters.gradient.items()
        ]
        assert max(moved) > 1e-2, name
        complete.loss.evaluate(FRACTION)
