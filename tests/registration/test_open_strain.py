"""The open strain of the head that slices of two orientations leave undetermined."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g3r.registration.open_strain import crossing_deg, open_strain
from g3r.registration.quality import PARALLEL, parallel_warnings
from g3r.registration.thresholds import MIN_CROSSING_DEG

X, Y, Z = np.eye(3)


def tilted(direction: np.ndarray, towards: np.ndarray, degrees: float) -> np.ndarray:
    return np.cos(np.deg2rad(degrees)) * direction + np.sin(np.deg2rad(degrees)) * towards


@pytest.mark.parametrize("other", [X, tilted(X, Z, 20), tilted(X, Z, -40)])
def test_two_orientations_leave_the_product_of_their_normals_open(other: np.ndarray) -> None:
    strain = open_strain(np.stack([Z, other]))
    assert strain is not None
    expected = np.outer(Z, other) + np.outer(other, Z)
    assert abs(np.vdot(strain, expected / np.linalg.norm(expected))) == pytest.approx(1)
    for normal in (Z, other):
        in_plane = np.eye(3) - np.outer(normal, normal)
        np.testing.assert_allclose(in_plane @ strain @ in_plane, 0, atol=1e-12)


@pytest.mark.parametrize("third", [X, -Z, tilted(X, Y, 8)])
def test_further_stacks_of_the_same_two_orientations_leave_it_open(third: np.ndarray) -> None:
    assert open_strain(np.stack([Z, X, third])) is not None


@pytest.mark.parametrize(
    "normals", [[Z], [Z, Z], [Z, tilted(Z, X, 30)], [X, Y, Z], [X, Z, tilted(X, Y, 30)], [Z, tilted(Z, X, 5), -Z]]
)
def test_one_and_three_orientations_do_not_leave_one_strain(normals: list[np.ndarray]) -> None:
    assert open_strain(np.stack(normals)) is None


def slices_along(*normals: np.ndarray, wobble_deg: float = 0.0) -> Any:
    """Stacks of 40 slices each with given orientation; slices tilt to both sides of the mean."""
    rotation, stack_id = [], []
    for stack, normal in enumerate(normals):
        turn = Rotation.align_vectors(normal[None], Z[None])[0]
        for sign in (1, -1):
            own = turn * Rotation.from_rotvec(sign * np.deg2rad(wobble_deg) * X)
            rotation += [own.as_matrix()] * 20
        stack_id += [stack] * 40
    return SimpleNamespace(stack_id=np.array(stack_id), planes=SimpleNamespace(rotation=np.array(rotation)))


@pytest.mark.parametrize(
    ("normals", "expected"),
    [
        ([Z, X], 90),
        ([Z, tilted(Z, X, 25)], 25),
        ([Z, -tilted(Z, X, 25)], 25),
        ([Z, tilted(Z, X, 15), tilted(Z, X, -20)], 35),
        ([X, Y, Z], 90),
    ],
)
@pytest.mark.parametrize("wobble_deg", [0.0, 20.0])
def test_stacks_cross_at_the_largest_angle_between_two(
    normals: list[np.ndarray], expected: float, wobble_deg: float
) -> None:
    slices = slices_along(*normals, wobble_deg=wobble_deg)
    assert crossing_deg(slices) == pytest.approx(expected, abs=1e-4)
    lines = parallel_warnings(slices)
    assert len(lines) == (expected < MIN_CROSSING_DEG)
    assert all(line.startswith(f"{PARALLEL} ({expected:.0f} degrees") for line in lines)


@pytest.mark.parametrize(("normals", "wobble_deg"), [([Z], 0.0), ([Z, tilted(Z, Y, 10)], 70.0)])
def test_nothing_is_said_of_one_stack_and_of_slices_all_about(normals: list[np.ndarray], wobble_deg: float) -> None:
    slices = slices_along(*normals, wobble_deg=wobble_deg)
    assert crossing_deg(slices) is None
    assert parallel_warnings(slices) == []
