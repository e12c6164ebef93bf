"""The common bias field: found if there is one, and not invented if there is none."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.acquisition import common_bias_field
from g3r.acquisition.common_bias_field import common_log_field, without_field
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import bounding_box

GRID = VolumeGrid.isotropic(np.full(3, -38.4), np.full(3, 38.4), 1.6)
WORLD = GRID.world(np.moveaxis(np.indices(GRID.shape), 0, -1))
BRAIN = np.linalg.norm(WORLD / [1.0, 0.85, 0.75], axis=-1) < 36


def tissues() -> np.ndarray:
    """Three intensities in shells with folds, so that the histogram has peaks."""
    radius = np.linalg.norm(WORLD / [1.0, 0.85, 0.75], axis=-1) + 3 * np.sin(WORLD[..., 0] / 4) * np.cos(
        WORLD[..., 1] / 4
    )
    noise = np.random.default_rng(0).normal(0, 0.01, GRID.shape)
    return (np.select([radius < 12, radius < 25], [1.0, 0.55], 0.75) + noise).astype(np.float32) * BRAIN


def field(strength: float) -> np.ndarray:
    """A smooth log-field with zero mean over the brain."""
    x, y, _ = np.moveaxis(WORLD / 40, -1, 0)
    log_field = strength * (x + 0.6 * y + 0.8 * x * y)
    return log_field - log_field[BRAIN].mean()


@pytest.fixture(scope="module")
def found() -> np.ndarray:
    """The estimate of a field of strength 0.1."""
    return common_log_field((tissues() * np.exp(field(0.1))).astype(np.float32), BRAIN, GRID)


def test_a_field_is_found(found: np.ndarray) -> None:
    true = field(0.1)
    left = np.sqrt(((found - true)[BRAIN] ** 2).mean())
    assert left < 0.5 * np.sqrt((true[BRAIN] ** 2).mean())
    assert abs(found[BRAIN].mean()) < 1e-6
    assert found.min() >= found[BRAIN].min() - 1e-6
    assert found.max() <= found[BRAIN].max() + 1e-6


def test_without_a_field_none_of_a_hundredth_is_found() -> None:
    assert np.abs(common_log_field(tissues(), BRAIN, GRID)[BRAIN]).mean() < 0.01


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_field_does_not_depend_on_the_unit_of_intensity(found: np.ndarray, scale: float) -> None:
    volume = tissues() * np.exp(field(0.1)) * scale
    np.testing.assert_allclose(common_log_field(volume, BRAIN, GRID), found, atol=1e-3)


@pytest.mark.parametrize("case", ["empty", "tiny", "flat", "one plane", "negative"])
def test_where_nothing_can_be_told_there_is_no_field(case: str) -> None:
    volume, brain = tissues(), BRAIN.copy()
    if case == "empty":
        brain[:] = False
    elif case == "tiny":
        brain[:] = False
        brain[20:23, 20:23, 20:23] = True
    elif case == "flat":
        volume = np.full(GRID.shape, 0.5, np.float32)
    elif case == "one plane":
        brain[:, :, :20], brain[:, :, 21:] = False, False
    else:
        volume = -volume
    assert not common_log_field(volume, brain, GRID).any()


@pytest.mark.parametrize(("second", "kept"), [(1.0, 1.0), (-1.0, 0.0), (0.5, 0.5625 / (0.5625 + 0.125))])
def test_what_two_looks_differ_in_counts_against_both(
    monkeypatch: pytest.MonkeyPatch, second: float, kept: float
) -> None:
    box = bounding_box(BRAIN)
    one = field(0.1)[box].astype(np.float32)
    answers = dict(zip(common_bias_field.LOOKS, (one, second * one), strict=True))
    monkeypatch.setattr(common_bias_field, "_n4", lambda volume, usable, spacing_mm, look: answers[look])
    result = common_log_field(tissues(), BRAIN, GRID)
    np.testing.assert_allclose(result[BRAIN], kept * (1 + second) / 2 * field(0.1)[BRAIN], atol=1e-6)


def test_one_look_that_finds_something_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    one = field(0.1)[bounding_box(BRAIN)].astype(np.float32)
    answers = dict(zip(common_bias_field.LOOKS, (one, None), strict=True))
    monkeypatch.setattr(common_bias_field, "_n4", lambda volume, usable, spacing_mm, look: answers[look])
    np.testing.assert_allclose(common_log_field(tissues(), BRAIN, GRID)[BRAIN], field(0.1)[BRAIN], atol=1e-6)


def test_slices_lose_the_field_where_they_are() -> None:
    shape, spacing = (40, 40, 12), np.array([1.5, 1.5, 4.0])
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = -(np.array(shape) - 1) / 2 * spacing
    world = np.moveaxis(np.indices(shape), 0, -1) @ affine[:3, :3] + affine[:3, 3]
    mask = np.linalg.norm(world, axis=-1) < 22
    log_field = (0.004 * WORLD[..., 0] - 0.006 * WORLD[..., 2]).astype(np.float32)
    image = np.exp(0.004 * world[..., 0] - 0.006 * world[..., 2]).astype(np.float32)
    slices = slices_from_stacks([Stack(image=image, mask=mask, affine=affine, thickness_mm=4.0)])
    np.testing.assert_allclose(without_field(slices, log_field, GRID).masked_value, 1, atol=1e-4)
