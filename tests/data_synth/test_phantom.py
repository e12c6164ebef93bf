"""The procedural brain: tissues, growth with age, reproducibility."""

import functools

import numpy as np
import pytest

from data_synth.phantom import LABELS, Phantom, fetal_brain_phantom
from data_synth.shapes import coverage, ellipsoid, smooth_noise, tube, union
from g3r.errors import InputError

AGES = (22.0, 30.0, 37.0)
SPACING_MM = 1.2


@functools.cache
def phantom(weeks: float, seed: int = 0) -> Phantom:
    return fetal_brain_phantom(weeks, SPACING_MM, seed)


def extent_mm(mask: np.ndarray) -> np.ndarray:
    inside = np.argwhere(mask)
    return (inside.max(0) - inside.min(0) + 1) * SPACING_MM


def folding(one: Phantom) -> float:
    """Ratio of the brain's surface to that of a ball of the same volume (in voxel faces)."""
    brain = np.isin(one.labels, [LABELS[n] for n in ("cortical_plate", "white_matter", "deep_grey", "ventricles")])
    faces = sum(int((np.diff(brain.astype(np.int8), axis=axis) != 0).sum()) for axis in range(3))
    return faces / float(brain.sum()) ** (2 / 3)


@pytest.mark.parametrize("weeks", AGES)
def test_types_and_tissues(weeks: float) -> None:
    one = phantom(weeks)
    assert one.t2.dtype == np.float32
    assert one.labels.dtype == np.uint8
    assert one.mask.dtype == np.bool_
    assert one.affine.dtype == np.float64
    assert one.t2.shape == one.labels.shape == one.mask.shape
    assert np.isfinite(one.t2).all()
    assert one.t2.min() >= 0
    assert 900 < one.t2.max() < 1150
    assert (one.t2[~one.mask] == 0).all()
    np.testing.assert_array_equal(one.labels > 0, one.mask)
    volume_ml = np.bincount(one.labels.ravel(), minlength=8) * SPACING_MM**3 / 1000
    assert (volume_ml[1:] > 1).all(), volume_ml


@pytest.mark.parametrize("weeks", AGES)
def test_contrast_of_t2(weeks: float) -> None:
    one = phantom(weeks)
    mean = {name: one.t2[one.labels == value].mean() for name, value in LABELS.items() if value}
    assert mean["cortical_plate"] < mean["white_matter"] < mean["ventricles"]
    assert mean["deep_grey"] < mean["white_matter"]
    assert mean["csf"] > 1.2 * mean["white_matter"]


def test_size_follows_age() -> None:
    for weeks, bpd_mm, ofd_mm in ((21.0, 52, 65), (30.0, 75, 95), (37.0, 92, 115)):
        size = extent_mm(phantom(weeks).mask)
        assert abs(size[0] - bpd_mm) < 5
        assert abs(size[1] - ofd_mm) < 5


def test_cortex_folds_with_age() -> None:
    young, middle, old = (folding(phantom(weeks)) for weeks in AGES)
    assert 1.1 * young < middle
    assert 1.1 * middle < old


def test_left_and_right_are_alike_but_not_equal() -> None:
    t2 = phantom(30.0).t2
    mask = phantom(30.0).mask & phantom(30.0).mask[::-1]
    similarity = np.corrcoef(t2[mask], t2[::-1][mask])[0, 1]
    assert 0.5 < similarity < 0.99


def test_seed_decides_everything() -> None:
    again = fetal_brain_phantom(30.0, SPACING_MM, 0)
    np.testing.assert_array_equal(again.t2, phantom(30.0).t2)
    np.testing.assert_array_equal(again.labels, phantom(30.0).labels)
    assert np.abs(phantom(30.0, 1).t2 - again.t2).mean() > 10


def test_grid_is_ras_and_centred() -> None:
    one = phantom(30.0)
    np.testing.assert_allclose(one.affine[:3, :3], np.eye(3) * SPACING_MM)
    middle = one.affine @ [*((np.array(one.t2.shape) - 1) / 2), 1]
    np.testing.assert_allclose(middle[:3], 0, atol=1e-9)
    center = np.argwhere(one.labels == LABELS["cerebellum"]).mean(0) - (np.array(one.t2.shape) - 1) / 2
    assert abs(center[0] * SPACING_MM) < 2  # on the midline, behind and below the centre
    assert center[1] * SPACING_MM < -10
    assert center[2] * SPACING_MM < -8


@pytest.mark.parametrize(("weeks", "spacing_mm"), [(10, 0.8), (50, 0.8), (float("nan"), 0.8), (30, 0.0), (30, 9.0)])
def test_impossible_requests(weeks: float, spacing_mm: float) -> None:
    with pytest.raises(InputError, match="expected"):
        fetal_brain_phantom(weeks, spacing_mm)


class TestShapes:
    axis = np.arange(-10, 11, dtype=np.float32)
    grid = (axis[:, None, None], axis[None, :, None], axis[None, None, :])

    def test_sphere_is_exact(self) -> None:
        x, y, z = self.grid
        expected = 5 - np.sqrt((x - 1) ** 2 + y**2 + z**2)
        np.testing.assert_allclose(ellipsoid(self.grid, (1, 0, 0), (5, 5, 5)), expected, atol=1e-4)

    def test_tube_narrows(self) -> None:
        distance = tube(self.grid, [(-5, 0, 0), (5, 0, 0)], [3, 1])
        np.testing.assert_allclose(distance[[5, 10, 15], 10, 10], [3, 2, 1], atol=1e-5)
        np.testing.assert_allclose(distance[20, 10, 10], 1 - 5, atol=1e-5)

    def test_union_and_coverage(self) -> None:
        a, b = np.array([1.0, -1.0, -3.0], np.float32), np.array([-1.0, -1.0, 2.0], np.float32)
        np.testing.assert_allclose(union(a, b), [1, -1, 2])
        assert (union(a, b, 1.0) >= np.maximum(a, b)).all()
        np.testing.assert_allclose(coverage(np.array([-5, 0, 0.25, 5], np.float32), 1.0), [0, 0.5, 0.75, 1])

    def test_noise_has_unit_variance(self) -> None:
        noise = smooth_noise((60, 60, 60), 4.0, 1.0, np.random.default_rng(0))
        assert 0.6 < noise.std() < 1.1
        assert np.corrcoef(noise[1:].ravel(), noise[:-1].ravel())[0, 1] > 0.9
