"""The explicit objective against autograd of the same loss through the reference, and finite differences."""

from dataclasses import replace

import numba
import numpy as np
import pytest
import torch

from g3r.acquisition.planes import volume_planes
from g3r.errors import NumericalError
from g3r.fitting.bias_field import StackBiasField
from g3r.fitting.objective import CloudObjective, ImageTerm
from g3r.fitting.parameters import FitParameters, LearningRates
from g3r.fitting.plane_state import PlaneState
from g3r.fitting.prior_stage import VolumeTarget
from g3r.fitting.slice_parameters import SliceParameters
from g3r.fitting.slice_stage import SliceStageSettings
from g3r.gaussians import GaussianCloud, render
from g3r.gaussians.overlap import OverlapFinder
from g3r.gaussians.render import CUTOFF_SIGMA
from tests.fitting.scene import BALL, GRID, fit, make_slices, seeded, true_volume
from tests.gaussians.scenes import cloud_of
from tests.gradients import gradient_of

SETTINGS = SliceStageSettings(scale_weight=0.3, bias_field_ridge=0.05, pose_prior_mm=2.0)
STRENGTH = 0.4


@pytest.fixture(scope="module")
def volume() -> np.ndarray:
    return true_volume()


class Scene:
    """A loss with every term, at a point where nothing is zero.

    At a cut-off of 6 sigma the dense reference gives the same image.
    """

    def __init__(self, volume: np.ndarray, seed: int, cutoff_sigma: float = CUTOFF_SIGMA) -> None:
        rng = np.random.default_rng(seed)
        self.slices = make_slices()
        n = len(self.slices)
        self.slice_weight = rng.uniform(0.2, 1, n).astype(np.float32).astype(float)
        cloud = seeded(volume)
        cloud = cloud.take(torch.arange(0, len(cloud), 3))
        self.bias_field = StackBiasField(self.slices)
        blocks = {
            "rotation": (rng.normal(0, 0.05, (n, 3)), 1e-3),
            "translation": (rng.normal(0, 0.3, (n, 3)), 0.03),
            "log_gain": (rng.normal(0, 0.2, n), 2e-3),
            "bias_field": (rng.normal(0, 0.2, (3, 5)), 8e-3),
        }
        self.parameters = FitParameters(cloud, LearningRates(), blocks)
        self.prior = VolumeTarget.of(np.float32(0.9) * volume, (BALL * 0.7).astype(np.float32), GRID)
        self.chosen = np.array([1, 5, 9, 14])
        self.unknowns = SliceParameters(self.slices, np.ones(n), self.parameters)
        self.term = ImageTerm.of(
            self.slices.planes,
            self.slices.value,
            self.slices.mask.astype(np.float32),
            basis=self.bias_field.basis,
            with_pose=True,
            cutoff_sigma=cutoff_sigma,
        )
        prior = ImageTerm.of(self.prior.planes, self.prior.value, self.prior.weight, cutoff_sigma=cutoff_sigma)
        self.distilled = prior.take(self.chosen)
        self.objective = CloudObjective(self.parameters, SETTINGS.scale_weight)
        self.seed = self.objective.seed_log_scale
        for name in ("mean_mm", "log_scale", "quaternion_wxyz", "amplitude"):
            value = self.parameters.value[name]
            value += rng.normal(0, 0.1, value.shape).astype(np.float32)

    def evaluate(self) -> float:
        """The explicit loss; its gradient is in the parameters."""
        step = self.objective.begin(
            {
                "slices": (self.term, self.unknowns.state(self.slice_weight)),
                "prior": (self.distilled, PlaneState.of(self.distilled.planes, self.parameters.origin_mm)),
            }
        )
        self.image = step.add("slices", 1.0)
        distance = step.add("prior", STRENGTH).mean
        regulariser = step.finish()
        others = self.unknowns.finish(self.image, SETTINGS.pose_prior_mm, SETTINGS.bias_field_ridge)
        return self.image.mean + STRENGTH * distance + regulariser + others

    def oracle(self) -> tuple[float, dict[str, np.ndarray]]:
        """The loss in float64 through the dense reference and autograd, term by term as in Eq. 9."""
        leaves = {name: torch.tensor(v).double().requires_grad_() for name, v in self.parameters.value.items()}
        cloud = GaussianCloud.of(
            [leaves[n] for n in ("mean_mm", "log_scale", "quaternion_wxyz", "amplitude")], self.parameters.origin_mm
        )
        log_gain = leaves["log_gain"] - leaves["log_gain"].mean()
        twist = torch.cat([leaves["rotation"], leaves["translation"]], 1)
        pixels = render(cloud, self.slices.planes, twist=twist, log_gain=log_gain, backend="reference")
        basis = torch.tensor(self.bias_field.basis).double()
        of_pixel = self.slices.stack_id[self.slices.planes.plane_id()]
        pixels = pixels * (leaves["bias_field"][of_pixel] * basis.T).sum(1).exp()
        weight = torch.tensor(self.slices.mask * self.slice_weight[self.slices.planes.plane_id()])
        image = (weight * (pixels - torch.tensor(self.slices.value)).abs()).sum() / weight.sum()
        part = self.prior.take(self.chosen)
        weight = torch.tensor(part.weight).double()
        near = render(cloud, part.planes, backend="reference") - torch.tensor(part.value)
        loss = image + STRENGTH * (weight * near.abs()).sum() / weight.sum()
        away = leaves["log_scale"] - torch.tensor(self.seed)
        loss = loss + SETTINGS.scale_weight * away.square().mean()
        loss = loss + SETTINGS.bias_field_ridge * leaves["bias_field"].square().mean()
        radius = np.sqrt(((self.slices.planes.shape * self.slices.planes.spacing_mm / 2) ** 2).sum(1)).mean() / 2
        moved = leaves["translation"].square().sum(1) + (radius * leaves["rotation"]).square().sum(1)
        loss = loss + image.item() * moved.mean() / SETTINGS.pose_prior_mm**2
        loss.backward()
        return loss.item(), {name: gradient_of(leaf).numpy() for name, leaf in leaves.items()}


@pytest.mark.parametrize("seed", [0, 1])
def test_value_and_gradients_are_those_of_autograd_through_the_reference(volume: np.ndarray, seed: int) -> None:
    scene = Scene(volume, seed, cutoff_sigma=6.0)
    expected, expected_gradient = scene.oracle()
    assert scene.evaluate() == pytest.approx(expected, rel=1e-5)
    for name, gradient in expected_gradient.items():
        found = scene.parameters.gradient[name]
        # |residual| has a kink, and rounding may put a pixel on the other side of it
        assert np.linalg.norm(found - gradient) < 2e-3 * np.linalg.norm(gradient), name


def test_gradients_are_finite_differences_of_the_value(volume: np.ndarray) -> None:
    scene = Scene(volume, 2, cutoff_sigma=6.0)
    scene.evaluate()
    image = scene.image.mean
    gradient = {name: g.astype(float) for name, g in scene.parameters.gradient.items()}
    rng = np.random.default_rng(3)
    for name, g in gradient.items():
        value = scene.parameters.value[name]
        start, direction = value.copy(), rng.uniform(size=value.shape) * np.sign(g)
        direction *= 0.02 / np.linalg.norm(direction)
        values = []
        for sign in (1, -1):
            value[...] = start + sign * direction
            values.append(scene.evaluate())
            # the pose prior is scaled by the image term, which has no gradient there
            one = replace(scene.image, mean=1.0)
            values[-1] += (image - scene.image.mean) * scene.unknowns.finish(one, SETTINGS.pose_prior_mm, 0.0)
        value[...] = start
        slope = float((g * direction).sum())
        assert (values[0] - values[1]) / 2 == pytest.approx(slope, rel=0.03), name


def test_the_kink_of_a_pixel_that_fits_has_no_gradient(volume: np.ndarray) -> None:
    scene = Scene(volume, 4)
    cloud = scene.parameters.cloud()
    value = render(cloud, scene.prior.planes).numpy()
    parameters = FitParameters(cloud, LearningRates())
    assert alone(parameters, ImageTerm.of(scene.prior.planes, value, np.ones_like(value))) == 0
    assert all((g == 0).all() for g in parameters.gradient.values())


def test_where_nothing_counts_the_term_is_zero(volume: np.ndarray) -> None:
    scene = Scene(volume, 5)
    term = ImageTerm.of(scene.prior.planes, scene.prior.value, 0 * scene.prior.weight)
    assert alone(scene.parameters, term) == 0
    assert (scene.parameters.gradient["mean_mm"] == 0).all()


def alone(parameters: FitParameters, term: ImageTerm) -> float:
    """The loss of one term; its gradient is in the parameters."""
    step = CloudObjective(parameters, 0.0).begin({"one": (term, PlaneState.of(term.planes, parameters.origin_mm))})
    image = step.add("one", 1.0).mean
    step.finish()
    return image


def test_no_pair_is_missed_while_things_move(volume: np.ndarray) -> None:
    """The current overlap list always holds every pair within the cut-off, and is not rebuilt at every step."""
    scene = Scene(volume, 6)
    for _ in range(12):
        loss = scene.evaluate()
        states = {"slices": scene.unknowns.state(scene.slice_weight), "prior": None}
        for name, held in scene.objective.overlaps.items():
            shapes, planes, state = scene.objective.shapes, held.term.planes, states[name] or held.state
            finder = OverlapFinder(len(shapes))
            needed = finder.find(shapes, planes, state.rotation, state.center_mm, CUTOFF_SIGMA)
            for k in range(len(planes)):
                kept = held.overlaps.gaussian[held.overlaps.start[k] : held.overlaps.start[k + 1]]
                now = needed.gaussian[needed.start[k] : needed.start[k + 1]]
                assert np.isin(now, kept).all()
        scene.parameters.step(loss, 0.1)
    assert scene.objective.n_searches < 6


def test_loss_and_gradients_of_one_and_two_threads_agree(volume: np.ndarray) -> None:
    if numba.config.NUMBA_NUM_THREADS < 2:  # type: ignore[attr-defined]
        pytest.skip("numba was started with one thread")
    before, found = numba.get_num_threads(), []
    try:
        for n_threads in (1, 2):
            numba.set_num_threads(n_threads)
            scene = Scene(volume, 7)
            loss = scene.evaluate()
            found.append((loss, {name: g.copy() for name, g in scene.parameters.gradient.items()}))
    finally:
        numba.set_num_threads(before)
    (one, one_gradient), (two, two_gradient) = found
    assert one == pytest.approx(two, rel=1e-6)
    for name, gradient in one_gradient.items():
        assert np.linalg.norm(gradient - two_gradient[name]) <= 1e-5 * np.linalg.norm(gradient), name


def test_a_short_fit_with_one_and_with_two_threads_gives_the_same_image(volume: np.ndarray) -> None:
    if numba.config.NUMBA_NUM_THREADS < 2:  # type: ignore[attr-defined]
        pytest.skip("numba was started with one thread")
    slices = make_slices()
    prior = VolumeTarget.of(volume, BALL.astype(np.float32), GRID)
    before, images = numba.get_num_threads(), []
    try:
        for n_threads in (1, 2):
            numba.set_num_threads(n_threads)
            images.append(render(fit(volume, slices, prior, n_steps=8).cloud, volume_planes(GRID)).numpy())
    finally:
        numba.set_num_threads(before)
    assert np.abs(images[0] - images[1]).max() <= 1e-5 * np.abs(images[0]).max()


def one_gaussian() -> GaussianCloud:
    return cloud_of(np.zeros((1, 3)), np.zeros((1, 3)), [[1.0, 0, 0, 0]], [2.0])


def test_a_step_is_that_of_torch_adam() -> None:
    rng = np.random.default_rng(8)
    rates = LearningRates()
    parameters = FitParameters(one_gaussian(), rates, {"extra": (rng.normal(size=(5, 2)), 0.01)})
    leaves = {name: torch.tensor(value.copy()) for name, value in parameters.value.items()}
    steps = (rates.mean_share, rates.log_scale, rates.quaternion, rates.amplitude_share * 2, 0.01)
    groups = [{"params": [leaf], "lr": step} for leaf, step in zip(leaves.values(), steps, strict=True)]
    adam = torch.optim.Adam(groups, betas=(0.9, 0.99))
    for n in range(20):
        for name, leaf in leaves.items():
            gradient = 10.0 ** rng.uniform(-7, 3, leaf.shape) * rng.choice([-1, 1], leaf.shape)
            parameters.gradient[name][...] = gradient
            leaf.grad = torch.tensor(gradient, dtype=torch.float32)
        factor = 1 / (1 + n)
        for group, step in zip(adam.param_groups, steps, strict=True):
            group["lr"] = step * factor
        adam.step()
        parameters.step(0.0, factor)
    for name, leaf in leaves.items():
        np.testing.assert_allclose(parameters.value[name], leaf.numpy(), rtol=2e-5, atol=2e-6)


def test_a_step_is_about_as_long_as_its_rate_says() -> None:
    rates = LearningRates()
    parameters = FitParameters(one_gaussian(), rates)
    for gradient in parameters.gradient.values():
        gradient[...] = 1.0
    parameters.step(1.0, 0.5)
    cloud = parameters.cloud()
    np.testing.assert_allclose(cloud.mean_mm, -0.5 * rates.mean_share, rtol=1e-4)  # sigma is 1 mm
    np.testing.assert_allclose(cloud.log_scale, -0.5 * rates.log_scale, rtol=1e-4)
    np.testing.assert_allclose(cloud.amplitude, 2 - 0.5 * rates.amplitude_share * 2, rtol=1e-4)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_stops_the_fit(bad: float) -> None:
    parameters = FitParameters(one_gaussian(), LearningRates())
    with pytest.raises(NumericalError, match="not finite") as caught:
        parameters.step(bad, 1.0)
    assert caught.value.exit_code == 4
    assert torch.equal(parameters.cloud().amplitude, one_gaussian().amplitude)


def test_a_gradient_that_is_not_finite_stops_the_fit() -> None:
    parameters = FitParameters(one_gaussian(), LearningRates())
    parameters.gradient["mean_mm"][0, 1] = np.nan
    with pytest.raises(NumericalError, match="not finite"):
        parameters.step(1.0, 1.0)


def test_pixels_that_are_not_finite_stop_the_fit(volume: np.ndarray) -> None:
    slices = make_slices()
    value = slices.value.copy()
    value[np.flatnonzero(slices.mask)[5]] = np.nan
    with pytest.raises(NumericalError, match="not finite"):
        fit(volume, replace(slices, value=value), n_steps=2, amplitude_iterations=0)
