"""Parts of the pose network against plain references, its symmetries, and overfitting of a tiny set."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from g3r.pose_network.config import PoseNetworkConfig
from g3r.pose_network.geometry import (
    best_age,
    group_mean,
    nearest_rotation,
    rotation_from_vector,
    sample_rows,
    scattered,
    smoothed,
)
from g3r.pose_network.network import PoseNetwork
from tests.gradients import gradient_of

SMALL = PoseNetworkConfig(template_shape=(2, 9, 9, 9), channels=(4, 8, 8), width=32, n_blocks=2, n_heads=2)


def rotations(n: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(Rotation.random(n, random_state=seed).as_matrix())


def random_batch(
    seed: int = 0, n_slices: int = 6, sets: tuple[int, ...] = (2, 1), size: int = 40
) -> dict[str, torch.Tensor]:
    """Noise images of a few stacks of a few heads."""
    generator = torch.Generator().manual_seed(seed)
    n_stacks = sum(sets)
    n = n_slices * n_stacks
    image = torch.rand(n, 1, size, size, generator=generator)
    image[:, :, :6] = 0
    header = rotations(n_stacks, seed).float().repeat_interleave(n_slices, 0)
    return {
        "image": image,
        "area_mm2": torch.full((n,), 2000.0),
        "position_mm": torch.linspace(-30, 30, n_slices).repeat(n_stacks),
        "thickness_mm": torch.full((n,), 3.0),
        "time_rank": torch.where(torch.rand(n, generator=generator) < 0.5, torch.nan, 0.3),
        "stack": torch.arange(n_stacks).repeat_interleave(n_slices),
        "set_of_stack": torch.repeat_interleave(torch.arange(len(sets)), torch.tensor(sets)),
        "header_rotation": header,
    }


def lively_network(**changes: Any) -> PoseNetwork:
    """A network with random weights large enough to matter."""
    torch.manual_seed(3)
    network = PoseNetwork(replace(SMALL, **changes)).eval()
    for part in (network.transformer, network.refining_transformer):
        torch.nn.init.normal_(part.vote.weight, std=0.3)
    network.set_template(torch.rand(2, 9, 9, 9))
    return network


def test_nearest_rotation_and_its_gradient() -> None:
    matrix = rotations(6) + 0.3 * torch.randn(6, 3, 3, dtype=torch.float64)
    matrix[0] = rotations(1)[0] @ torch.diag(torch.tensor([1.0, 1.0, 1.0], dtype=torch.float64))  # a triple value
    matrix.requires_grad_()
    nearest = nearest_rotation(matrix)
    torch.testing.assert_close(nearest @ nearest.transpose(1, 2), torch.eye(3).double().expand(6, 3, 3))
    assert (torch.linalg.det(nearest) > 0).all()
    for near, one in zip(nearest, matrix, strict=True):  # no other rotation is closer
        distance = (rotations(200, 1) - one).square().sum((1, 2)).min()
        assert (near - one).square().sum() <= distance
    assert torch.autograd.gradcheck(nearest_rotation, matrix)


def test_gradient_stays_finite_where_the_rotation_is_undetermined() -> None:
    matrix = torch.zeros(2, 3, 3, requires_grad=True)
    nearest_rotation(matrix).square().sum().backward()
    assert torch.isfinite(gradient_of(matrix)).all()


def test_rotation_from_vector() -> None:
    vector = torch.tensor([[0.0, 0.0, 0.0], [0.02, -0.03, 0.01], [1.0, 2.0, -0.5]], dtype=torch.float64)
    rotation = rotation_from_vector(vector)
    torch.testing.assert_close(rotation @ rotation.transpose(1, 2), torch.eye(3).double().expand(3, 3, 3))
    small = Rotation.from_rotvec(vector[1].numpy()).as_matrix()
    np.testing.assert_allclose(rotation[1], small, atol=1e-5)


def test_group_mean_of_an_empty_group_is_zero() -> None:
    value = torch.tensor([[1.0], [3.0], [10.0]])
    assert group_mean(value, torch.tensor([0, 0, 2]), 4).flatten().tolist() == [2.0, 0.0, 10.0, 0.0]


def test_sampling_is_trilinear_and_zero_outside(rng: np.random.Generator) -> None:
    volumes = rng.random((2, 5, 6, 7, 3)).astype(np.float32)
    points = rng.uniform(-9, 9, (2, 50, 3)).astype(np.float32)
    sampled = sample_rows(torch.from_numpy(volumes), torch.from_numpy(points), 2.5, torch.tensor([1, 0]))
    for block, which in ((0, 1), (1, 0)):
        index = points[block].T / 2.5 + np.array([[2.0], [2.5], [3.0]])
        inside = (index >= 0).all(0) & (index.T <= [4, 5, 6]).all(1)
        assert 0 < inside.sum() < 50
        for channel in range(3):
            expected = map_coordinates(volumes[which, ..., channel], index, order=1, mode="nearest")
            np.testing.assert_allclose(sampled[block, :, channel], expected * inside, atol=1e-5)


def test_scattering_keeps_sums(rng: np.random.Generator) -> None:
    points = torch.from_numpy(rng.uniform(-10, 10, (3, 40, 3)))
    value, weight = torch.rand(3, 40).double(), (torch.rand(3, 40) < 0.7).double()
    volume = scattered(points, value, weight, torch.tensor([0, 1, 0]), 2, 11, 2.0)
    torch.testing.assert_close(volume[..., 0].sum(), (value * weight).sum())
    torch.testing.assert_close(volume[1, ..., 1].sum(), weight[1].sum())


def test_smoothing_keeps_sums_and_symmetry() -> None:
    volume = torch.zeros(1, 7, 7, 7)
    volume[0, 3, 3, 3] = 8.0
    blurred = smoothed(volume)
    assert float(blurred.sum()) == pytest.approx(8.0)
    assert float(blurred[0, 3, 3, 3]) == pytest.approx(1.0)
    torch.testing.assert_close(blurred, blurred.flip(1, 2, 3))


def test_best_age_is_the_one_that_correlates(rng: np.random.Generator) -> None:
    heads = torch.from_numpy(rng.random((6, 30, 3)))
    value = torch.cat([0.5 * heads[:4, :, 2] + 0.3, 2 * heads[4:, :, 0]])
    value = value + 0.05 * torch.from_numpy(rng.random((6, 30)))
    assert best_age(heads, value, torch.tensor([0, 0, 0, 0, 1, 1]), 2).tolist() == [2, 0]


def test_every_step_gives_rigid_poses() -> None:
    with torch.no_grad():
        steps = lively_network()(random_batch(), n_refinements=2)
    assert len(steps) == 3
    for step in steps:
        product = step.rotation @ step.rotation.transpose(1, 2)
        torch.testing.assert_close(product, torch.eye(3).expand_as(product), atol=1e-5, rtol=0)
        assert (torch.linalg.det(step.rotation) > 0).all()
        assert torch.isfinite(step.translation_mm).all()


def test_turning_all_headers_of_a_head_changes_nothing() -> None:
    network, batch = lively_network(), random_batch()
    turned = dict(batch)
    turn = rotations(2, seed=5).float()[batch["set_of_stack"][batch["stack"]]]
    turned["header_rotation"] = turn @ batch["header_rotation"]
    with torch.no_grad():
        for one, other in zip(network(batch), network(turned), strict=True):
            torch.testing.assert_close(one.rotation, other.rotation, atol=1e-3, rtol=0)
            torch.testing.assert_close(one.translation_mm, other.translation_mm, atol=1e-2, rtol=0)


def test_headers_between_stacks_do_count() -> None:
    network, batch = lively_network(), random_batch()
    changed = dict(batch)
    changed["header_rotation"] = batch["header_rotation"].clone()
    changed["header_rotation"][batch["stack"] == 0] = rotations(1, 9).float()
    with torch.no_grad():
        one, other = network(batch)[0].rotation, network(changed)[0].rotation
    assert (one - other)[batch["stack"] == 1].abs().max() > 1e-3
    torch.testing.assert_close(one[batch["stack"] == 2], other[batch["stack"] == 2])  # the stack of another head


def test_heads_of_a_batch_do_not_see_each_other() -> None:
    network, batch = lively_network(), random_batch()
    rows = batch["set_of_stack"][batch["stack"]] == 0
    alone = {name: value[rows] for name, value in batch.items() if name != "set_of_stack"}
    alone["set_of_stack"] = batch["set_of_stack"][batch["set_of_stack"] == 0]
    with torch.no_grad():
        together, single = network(batch)[-1], network(alone)[-1]
    torch.testing.assert_close(together.rotation[rows], single.rotation, atol=1e-3, rtol=0)


def test_a_tiny_set_can_be_learnt() -> None:
    from g3r.pose_network.geometry import moved_points
    from g3r.training.pose_scores import SLICE_POINTS_MM

    torch.manual_seed(0)
    batch = random_batch(n_slices=4, sets=(2,))
    rotation = rotations(8, seed=4).float()
    shift = 10 * torch.randn(8, 3)
    points = torch.tensor(SLICE_POINTS_MM, dtype=torch.float32)
    true = moved_points(rotation, shift, points)
    network = PoseNetwork(SMALL).train()
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    losses = []
    for _ in range(150):
        steps = network(batch)
        where = [moved_points(step.rotation, step.translation_mm, points) for step in steps]
        distance = [(one - true).norm(dim=-1) for one in where]
        loss = torch.stack(distance).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[0] > 25
    assert losses[-1] < 0.35 * losses[0]


@pytest.mark.parametrize(
    "changes",
    [
        {"image_size": 42},
        {"pixel_mm": 0.0},
        {"pixel_mm": float("nan")},
        {"template_shape": (2, 9, 9)},
        {"template_shape": (2, 9, 9, 10_000)},
        {"template_spacing_mm": 1e9},
        {"channels": (8, 8)},
        {"channels": (8, 8, 10**6)},
        {"width": 30, "n_heads": 4},
        {"width": 10**6},
        {"n_heads": 0},
        {"n_blocks": 1000},
        {"n_refinements": 0},
    ],
)
def test_wrong_arguments(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="no pose network has these arguments"):
        replace(SMALL, **changes)


def test_the_default_is_small() -> None:
    network = PoseNetwork(PoseNetworkConfig(template_shape=(6, 39, 45, 43)))
    assert sum(p.numel() for p in network.parameters()) <= 2_000_000
