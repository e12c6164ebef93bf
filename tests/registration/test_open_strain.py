"""Which strain of the head the slices of two orientations leave open."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.registration.open_strain import open_strain

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
