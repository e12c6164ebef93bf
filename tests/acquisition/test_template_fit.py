"""A template fitted to the seen part of a head predicts the unseen part better than a template that is only placed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from g3r.acquisition.atlas_template import PlacedHead
from g3r.acquisition.template_fit import TemplateFit, fit_template
from g3r.geometry import VolumeGrid

RADII_MM = np.array([28.0, 34.0, 25.0])
TEMPLATE_GRID = VolumeGrid.isotropic([-36, -42, -33], [36, 42, 33], 2.0)
GRID = VolumeGrid.isotropic([-42, -46, -40], [42, 46, 40], 2.0)

SIZE = np.diag([1.08, 0.94, 1.05])
TURN = Rotation.from_euler("xyz", [5, -4, 6], degrees=True).as_matrix()
SHIFT_MM = np.array([3.0, -2.0, 2.5])
WAVE_MM = 2.0


def world(grid: VolumeGrid) -> np.ndarray:
    return grid.world(np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), -1))


def brain(place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intensity and mask of a brain with dark and bright structures, at positions [..., 3] in mm."""
    radius = np.linalg.norm(place / RADII_MM, axis=-1)
    inside = radius < 1
    x, y, z = np.moveaxis(place, -1, 0)
    value = 0.55 + 0.2 * np.cos(x / 4.5) * np.cos(y / 5.5) + 0.15 * np.sin(z / 4) - 0.3 * (radius > 0.85)
    for side in (-1, 1):
        value = value + 0.5 * np.exp(-(((place - [9 * side, 4, 2]) / [4, 9, 5]) ** 2).sum(-1))
    return np.where(inside, np.clip(value, 0.05, None), 0).astype(np.float32), inside


def head_in_template(place: np.ndarray) -> np.ndarray:
    """Position of a point of the head in the template: an affine map, then a wave."""
    moved = (place - SHIFT_MM) @ TURN @ np.linalg.inv(SIZE)
    return moved + WAVE_MM * np.sin(moved[..., [1, 2, 0]] / 14)


TEMPLATE = brain(world(TEMPLATE_GRID))[0]
PLACED = PlacedHead.of(TEMPLATE, TEMPLATE_GRID)
TRUTH, INSIDE = brain(head_in_template(world(GRID)))
HEAD = (1.3 * TRUTH - 0.35 * TRUTH**2).astype(np.float32)  # another contrast


def case(hidden: np.ndarray) -> dict[str, Any]:
    """The seen head with noise; the coverage fades into the hidden part."""
    seen = gaussian_filter((~hidden).astype(np.float32), 0.75)
    known = seen > 1e-3
    noise = 0.05 * np.random.default_rng(0).standard_normal(GRID.shape).astype(np.float32)
    return {"head": (HEAD + noise) * known, "share": (INSIDE & known).astype(np.float32), "density": seen, "grid": GRID}


SLABS = {
    "a slab in the middle": (world(GRID)[..., 2] > -4) & (world(GRID)[..., 2] < 10),
    "an end": world(GRID)[..., 1] > 14,
}


def coloured(values: np.ndarray, part: np.ndarray) -> np.ndarray:
    """The best combination of t and t^2 in the given voxels, an upper bound for any fit."""
    terms = np.stack([values[part], values[part] ** 2], -1)
    return terms @ np.linalg.lstsq(terms, HEAD[part], rcond=None)[0]


def dice(one: np.ndarray, other: np.ndarray) -> float:
    return float(2 * (one & other).sum() / (one.sum() + other.sum()))


@pytest.fixture(scope="module", params=SLABS)
def hidden(request: pytest.FixtureRequest) -> np.ndarray:
    return SLABS[request.param]


@pytest.fixture(scope="module")
def fitted(hidden: np.ndarray) -> TemplateFit:
    return fit_template(PLACED, **case(hidden))


def test_the_hidden_part_is_found(hidden: np.ndarray, fitted: TemplateFit) -> None:
    part = hidden & INSIDE
    placed = brain(world(GRID))[0]  # the template in its initial place
    before = float(np.sqrt(((coloured(placed, part) - HEAD[part]) ** 2).mean()))
    after = float(np.sqrt(((fitted.values[part] - HEAD[part]) ** 2).mean()))
    assert after < 0.65 * before
    hidden_brain = dice((fitted.inside > 0.5) & hidden, part)
    assert hidden_brain > 0.94
    assert 1 - hidden_brain < 0.6 * (1 - dice((placed > 0) & hidden, part))


def test_the_seen_part_fits_better_still(hidden: np.ndarray, fitted: TemplateFit) -> None:
    part = ~hidden & INSIDE
    assert np.corrcoef(fitted.values[part], HEAD[part])[0, 1] > 0.9
    assert fitted.values[part].mean() == pytest.approx(HEAD[part].mean(), rel=0.08)
    assert fitted.loss < 0.003


def test_the_background_stays_zero(fitted: TemplateFit) -> None:
    assert fitted.values.dtype == fitted.inside.dtype == np.float32
    assert fitted.values.shape == fitted.inside.shape == GRID.shape
    assert fitted.values.min() == 0
    assert (fitted.values[fitted.inside == 0] == 0).all()
    assert 0 <= fitted.inside.min() <= fitted.inside.max() <= 1 + 1e-6
    far = np.linalg.norm(world(GRID) / RADII_MM, axis=-1) > 1.35
    assert far.sum() > 1000
    assert (fitted.values[far] == 0).all()


QUICK = (2, 2)


def quickly() -> TemplateFit:
    return fit_template(PLACED, **case(SLABS["an end"]), n_steps=QUICK)


@pytest.mark.parametrize("fails", [False, True])
def test_torch_gets_its_threads_back(fails: bool) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        if fails:
            with pytest.raises((ValueError, RuntimeError)):
                fit_template(replace(PLACED, volume=TEMPLATE[0]), **case(SLABS["an end"]), n_steps=QUICK)
        else:
            quickly()
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_it_works_where_gradients_are_off() -> None:
    expected = quickly()
    with torch.inference_mode():
        found = quickly()
    np.testing.assert_array_equal(found.values, expected.values)
    with torch.no_grad():
        found = quickly()
    np.testing.assert_array_equal(found.values, expected.values)
    assert not torch.is_inference_mode_enabled()


def test_it_is_the_same_whatever_the_density() -> None:
    given, seen = case(SLABS["an end"]), ~SLABS["an end"]
    once, dense = (seen * np.where(world(GRID)[..., 0] > 0, n, 1).astype(np.float32) for n in (1, 9))
    expected, found = (fit_template(PLACED, **{**given, "density": one}, n_steps=QUICK) for one in (once, dense))
    np.testing.assert_array_equal(found.values, expected.values)


def test_nothing_seen_is_no_failure() -> None:
    given = case(np.ones(GRID.shape, bool))
    found = fit_template(PLACED, **given, n_steps=QUICK)
    assert np.isfinite(found.values).all()
    # the outline is that of the placed template
    assert dice(found.inside > 0.5, brain(world(GRID))[1]) > 0.96
