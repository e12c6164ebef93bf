"""Rigid alignment: recovery of known motions, use of headers, reproducibility."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import SimpleITK as sitk
from scipy.ndimage import map_coordinates

from g3r.acquisition.images import Volume
from g3r.errors import InputError
from g3r.evaluation import align
from g3r.evaluation.align import align_rigid, resample
from g3r.evaluation.compare import compare
from g3r.geometry import RigidPose, VolumeGrid

GRID = VolumeGrid.isotropic((-40, -48, -36), (40, 48, 36), 2.0)
SHEAR = np.eye(4)
SHEAR[0, 1] = 0.2


def brain(points_mm: np.ndarray) -> np.ndarray:
    """An asymmetric ellipsoid with inner structure, defined at any world point [..., 3]."""
    x, y, z = np.moveaxis(points_mm, -1, 0)
    inside = 1 / (1 + np.exp(2.0 * (np.sqrt((x / 28) ** 2 + (y / 36) ** 2 + (z / 24) ** 2) - 1) * 12))
    texture = 500 + 160 * np.sin(x / 5 + 0.3 * y / 7) + 140 * np.cos(y / 6 + 1) + 120 * np.sin(z / 4 + x / 11)
    bump = 500 * np.exp(-((x - 14) ** 2 + (y - 18) ** 2 + (z - 6) ** 2) / 60)
    return (inside * (texture + bump)).astype(np.float32)


def on_grid(grid: VolumeGrid, pose: RigidPose | None = None) -> tuple[Volume, np.ndarray]:
    """The brain sampled on a grid after a motion; mask of the brain."""
    points = grid.world(np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), -1))
    points = points if pose is None else pose.inverse().apply(points[None])[0]
    data = brain(points)
    return Volume(data, grid.affine, "phantom"), data > 100


def pose_deg(rotation: Sequence[float], translation_mm: Sequence[float]) -> RigidPose:
    return RigidPose.from_rotvec(np.deg2rad([rotation]), [translation_mm])


@pytest.mark.parametrize(
    ("rotation_deg", "translation_mm", "near"),
    [
        ((0, 0, 0), (0, 0, 0), False),
        ((4, -6, 3), (3, -2, 5), False),
        ((4, -6, 3), (3, -2, 5), True),
        ((18, 12, -22), (9, 4, -7), False),
    ],
)
def test_a_known_motion_is_found(
    rotation_deg: tuple[int, int, int], translation_mm: tuple[int, int, int], near: bool
) -> None:
    reference, mask = on_grid(GRID)
    pose = pose_deg(rotation_deg, translation_mm)
    moved, _ = on_grid(VolumeGrid.isotropic((-52, -60, -50), (56, 60, 48), 1.7), pose)
    found = align_rigid(moved, reference, mask, near=near)
    points = GRID.world(np.argwhere(mask)[::50])
    error = np.linalg.norm((found.volume_from_reference.apply(points[None]) - pose.apply(points[None]))[0], axis=1)
    assert error.max() < 0.1 * GRID.spacing_mm[0]
    assert found.ncc > 0.99
    assert found.rotation_deg == pytest.approx(np.linalg.norm(rotation_deg), abs=0.3)


def test_other_orientations_are_not_tried_where_the_volume_is_near(monkeypatch: pytest.MonkeyPatch) -> None:
    reference, mask = on_grid(GRID)
    noise = np.random.default_rng(0).normal(0, reference.data.std(), reference.data.shape)
    unlike = Volume((reference.data + noise).astype(np.float32), reference.affine, "noise")
    tried: list[tuple[int, ...]] = []

    def register(*arguments: Any, **options: Any) -> tuple[float, sitk.Euler3DTransform]:
        tried.append(options["levels"])
        return 0.5, arguments[3]

    monkeypatch.setattr(align, "_register", register)
    n_tried = {}
    for near in (False, True):
        align_rigid(unlike, reference, mask, near=near)
        n_tried[near] = tried.count((align.COARSE_SHRINK,))
        tried.clear()
    assert n_tried == {False: 28, True: 2}


def test_same_input_same_result() -> None:
    reference, mask = on_grid(GRID)
    moved, _ = on_grid(GRID, pose_deg((5, 2, -3), (2, 1, -2)))
    first, second = (align_rigid(moved, reference, mask).volume_from_reference for _ in range(2))
    np.testing.assert_array_equal(first.rotation, second.rotation)
    np.testing.assert_array_equal(first.translation_mm, second.translation_mm)


def test_resampling_on_the_same_grid_changes_nothing() -> None:
    volume, _ = on_grid(GRID)
    np.testing.assert_array_equal(resample(volume, GRID), volume.data)


@pytest.mark.parametrize("flip", [(), (0,), (0, 1), (2,)])
def test_resampling_follows_the_header(flip: tuple[int, ...]) -> None:
    volume, mask = on_grid(GRID)
    affine = GRID.affine.copy()
    for axis in flip:
        affine[:3, 3] += affine[:3, axis] * (GRID.shape[axis] - 1)
        affine[:3, axis] *= -1
    flipped = Volume(np.ascontiguousarray(np.flip(volume.data, flip)), affine, "flipped")
    np.testing.assert_allclose(resample(flipped, GRID)[mask], volume.data[mask], atol=0.2)  # of 1000


def test_resampling_agrees_with_scipy_on_an_oblique_grid() -> None:
    volume, _ = on_grid(GRID)
    pose = pose_deg((10, -20, 30), (3, 4, -5))
    affine = np.eye(4)
    affine[:3, :3] = pose.rotation[0] * 1.8
    affine[:3, 3] = (-30, -30, -20)
    grid = VolumeGrid((20, 22, 18), affine)
    index = GRID.index(grid.world(np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), -1)))
    expected = map_coordinates(volume.data, np.moveaxis(index, -1, 0), order=3, mode="mirror")
    inner = ((index > 1) & (index < np.array(GRID.shape) - 2)).all(-1)
    np.testing.assert_allclose(resample(volume, grid)[inner], expected[inner], atol=0.5)  # of 1000


def test_compare_with_and_without_alignment(rng: np.random.Generator) -> None:
    reference, mask = on_grid(GRID)
    moved, _ = on_grid(GRID, pose_deg((6, 3, -4), (3, 2, -3)))
    noisy = Volume(
        moved.data / np.float32(50) + rng.normal(0, 0.2, GRID.shape).astype(np.float32), GRID.affine, "moved"
    )
    headers, aligned = compare(noisy, reference, mask), compare(noisy, reference, mask, align=True)
    still = Volume(
        reference.data / np.float32(50) + rng.normal(0, 0.2, GRID.shape).astype(np.float32), GRID.affine, "still"
    )
    assert headers.alignment is None
    assert headers.scores.psnr_db < 20
    # interpolation smooths the noise slightly, so the moved volume may score better than the still one
    assert -0.3 < aligned.scores.psnr_db - compare(still, reference, mask).scores.psnr_db < 3
    assert np.abs(aligned.volume[mask].mean() / reference.data[mask].mean() - 1) < 0.01


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda v, r: (Volume(v.data * np.nan, v.affine, "v"), r), "no finite value"),
        (lambda v, r: (Volume(v.data * 0, v.affine, "v"), r), "zero all over the mask"),
        (lambda v, r: (v, Volume(r.data * np.nan, r.affine, "r")), "not finite in the mask"),
        (lambda v, r: (v, Volume(-r.data, r.affine, "r")), "not positive"),
        (lambda v, r: (Volume(v.data, v.affine @ SHEAR, "v"), r), "sheared"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    spoil: Callable[[Volume, Volume], tuple[Volume, Volume]], message: str
) -> None:
    reference, mask = on_grid(GRID)
    with pytest.raises(InputError, match=message):
        compare(*spoil(reference, reference), mask)
