"""Heads of an atlas template: the one nearest in age, scaled about its own centre."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.geometry import VolumeGrid

GRID = VolumeGrid.isotropic([-30, -30, -30], [30, 30, 30], 2.0)
WORLD = GRID.world(np.stack(np.meshgrid(*[np.arange(n) for n in GRID.shape], indexing="ij"), -1))
CENTER_MM = np.array([0.0, 4.0, -2.0])


def ball(radius_mm: float, world: np.ndarray = WORLD) -> np.ndarray:
    place = world - CENTER_MM
    value = 0.6 + 0.2 * np.sin(place[..., 0] / 4) + 0.2 * np.cos(place[..., 1] / 3 + place[..., 2] / 5)
    return np.where(np.linalg.norm(place, axis=-1) < radius_mm, value, 0).astype(np.float32)


TEMPLATE = AtlasTemplate(np.stack([ball(16), ball(20), ball(24)]), GRID.affine, np.array([24.0, 28.0, 33.0]))


@pytest.mark.parametrize(("weeks", "expected"), [(20.0, 0), (25.9, 0), (26.1, 1), (30.4, 1), (30.6, 2), (40.0, 2)])
def test_the_nearest_age_is_taken(weeks: float, expected: int) -> None:
    placed = TEMPLATE.scaled_head(weeks, 1.0)
    np.testing.assert_array_equal(placed.volume, TEMPLATE.volume[expected])
    np.testing.assert_allclose(placed.grid.affine, TEMPLATE.affine, atol=1e-9)


@pytest.mark.parametrize("scale", [0.8, 1.25])
def test_it_is_enlarged_about_its_own_centre(scale: float) -> None:
    placed = TEMPLATE.scaled_head(28.0, scale)
    inside = placed.grid.world(np.argwhere(placed.volume > 0))
    np.testing.assert_allclose(inside.mean(0), CENTER_MM, atol=0.05)
    np.testing.assert_array_equal(placed.center_mm, inside.mean(0))
    low, high = placed.box_mm()
    np.testing.assert_allclose(high - low, 2 * 20 * scale, atol=4.1 * scale)
    np.testing.assert_allclose((low + high) / 2, CENTER_MM, atol=1.1 * scale)
    np.testing.assert_allclose(low, inside.min(0))
    np.testing.assert_allclose(placed.grid.spacing_mm, 2 * scale)
    np.testing.assert_allclose(TEMPLATE.affine, GRID.affine)  # the atlas template itself is unchanged
