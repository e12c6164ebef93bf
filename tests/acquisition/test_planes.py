"""Planes and slices: selection, motion, refusals; a volume as planes."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes, volume_from_pixels, volume_planes
from g3r.acquisition.slicing import slices_from_stacks
from g3r.geometry import RigidPose, VolumeGrid
from tests.acquisition.nifti_files import AXES, affine_of, stacks_of_two


@pytest.mark.parametrize("index", [[3, 0, 7], slice(2, 6), "mask", []])
def test_take_keeps_pixels_values_and_slices_together(index: Any) -> None:
    slices = slices_from_stacks(stacks_of_two())
    if index == "mask":
        index = np.arange(len(slices)) % 3 == 1
    chosen = np.arange(len(slices))[index]
    part = slices.take(index)
    assert len(part) == len(chosen)
    np.testing.assert_array_equal(part.stack_id, slices.stack_id[chosen])
    np.testing.assert_array_equal(part.slice_index, slices.slice_index[chosen])
    np.testing.assert_array_equal(part.thickness_mm, slices.thickness_mm[chosen])
    world, offset = slices.planes.pixel_world_mm(), slices.planes.offset
    part_world = part.planes.pixel_world_mm()
    for new, old in enumerate(chosen):
        old_pixels, new_pixels = (slice(offset[old], offset[old + 1]), slice(*part.planes.offset[new : new + 2]))
        np.testing.assert_array_equal(part.value[new_pixels], slices.value[old_pixels])
        np.testing.assert_array_equal(part.mask[new_pixels], slices.mask[old_pixels])
        np.testing.assert_array_equal(part_world[new_pixels], world[old_pixels])
        np.testing.assert_array_equal(part.header_pose.rotation[new], slices.header_pose.rotation[old])


def test_a_pixel_covers_its_area_times_the_thickness() -> None:
    slices = slices_from_stacks(stacks_of_two())
    expected = [x * y * t for (x, y), t in zip(slices.planes.spacing_mm, slices.thickness_mm, strict=True)]
    np.testing.assert_array_equal(slices.pixel_volume_mm3, expected)
    assert slices.typical_pixel_mm == pytest.approx(np.cbrt(np.median(expected)))


def test_gains_are_divided_out_slice_by_slice(rng: np.random.Generator) -> None:
    slices = slices_from_stacks(stacks_of_two())
    gain = rng.uniform(0.5, 2, len(slices))
    evened = slices.without_gain(gain)
    assert evened.value.dtype == np.float32
    first, end = slices.planes.offset[3:5]
    np.testing.assert_allclose(evened.value[first:end], slices.value[first:end] / gain[3], rtol=1e-6)
    np.testing.assert_array_equal(slices.masked_value_without(gain).astype(np.float32), evened.masked_value)
    np.testing.assert_array_equal(slices.masked_value_without(None), slices.masked_value)


def test_moving_the_world_moves_the_pixels_and_is_reported() -> None:
    slices = slices_from_stacks(stacks_of_two())
    motion = RigidPose.from_rotvec([[0.2, -0.1, 0.4]], [[5.0, -3, 2]])
    moved = slices.with_pose(motion @ slices.planes.pose)
    expected = motion.apply(slices.planes.pixel_world_mm()[None])[0]
    np.testing.assert_allclose(moved.planes.pixel_world_mm(), expected, atol=1e-10)
    np.testing.assert_allclose(slices.planes.moved(motion).pixel_world_mm(), expected, atol=1e-10)
    reported = moved.world_from_header()
    np.testing.assert_allclose(reported.rotation, np.tile(motion.rotation, (len(slices), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(reported.translation_mm - motion.translation_mm, 0, atol=1e-10)


def test_volume_planes_are_the_volume_in_order() -> None:
    data = np.random.default_rng(3).normal(size=(5, 4, 3)).astype(np.float32)
    for axes in AXES.values():
        grid = VolumeGrid(data.shape, affine_of(axes))
        planes = volume_planes(grid)
        pixels = data.transpose(2, 0, 1).ravel()
        np.testing.assert_array_equal(volume_from_pixels(pixels, grid), data)
        index = np.stack(np.meshgrid(*[np.arange(n) for n in data.shape], indexing="ij"), -1)
        expected = grid.world(index).transpose(2, 0, 1, 3).reshape(-1, 3)
        np.testing.assert_allclose(planes.pixel_world_mm(), expected, atol=1e-9)
        assert (planes.psf_var_mm2 == 0).all()


def test_axes_may_be_as_orthogonal_as_those_of_a_stack() -> None:
    for cosine in (1e-5, 9e-4):
        grid = VolumeGrid((5, 4, 3), affine_of(AXES["oblique"] @ (np.eye(3) + cosine * np.eye(3, k=1))))
        assert grid.shear > 0.9 * cosine
        index = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), -1)
        expected = grid.world(index).transpose(2, 0, 1, 3).reshape(-1, 3)
        np.testing.assert_allclose(volume_planes(grid).pixel_world_mm(), expected, atol=1e-9)
    with pytest.raises(ValueError, match=r"orthogonal axes; these are sheared \(cosine 0\.002\)"):
        volume_planes(VolumeGrid((5, 4, 3), affine_of(np.eye(3) + 2e-3 * np.eye(3, k=1))))


@pytest.mark.parametrize(
    "change",
    [
        {"spacing_mm": [[0.0, 1]]},
        {"shape": [[0, 3]]},
        {"psf_var_mm2": [[-1.0, 0, 0]]},
        {"center_mm": [[np.nan, 0, 0]]},
        {"center_mm": [[0.0, 0]]},
    ],
)
def test_planes_without_meaning_are_refused(change: dict[str, list[list[float]]]) -> None:
    good: dict[str, Any] = {
        "rotation": np.eye(3)[None],
        "center_mm": [[0.0, 0, 0]],
        "spacing_mm": [[1.0, 1]],
        "shape": [[4, 3]],
        "psf_var_mm2": [[0.1, 0.1, 1.0]],
    }
    Planes(**good)
    with pytest.raises(ValueError, match=r"planes need|expected|finite"):
        Planes(**(good | change))


def test_records_print_their_sizes_in_one_line() -> None:
    stack = stacks_of_two()[1]
    slices = slices_from_stacks(stacks_of_two())
    assert repr(stack) == "Stack(second: 9 x 16 x 5 voxels of 0.8 x 0.9 x 3 mm, 2 mm thick)"
    assert repr(slices).startswith(f"Slices({len(slices)} slices of 2 stacks, {len(slices.pixel_index)} ")
    assert repr(slices.planes) == f"Planes({len(slices)} planes, {slices.planes.n_pixels} pixels)"


def test_pixels_lie_where_their_planes_say(rng: np.random.Generator) -> None:
    rotation = Rotation.random(3, random_state=5).as_matrix()
    planes = Planes(
        rotation=rotation,
        center_mm=rng.normal(size=(3, 3)),
        spacing_mm=np.array([[1.0, 2.0], [0.7, 0.9], [3.0, 0.5]]),
        shape=np.array([[3, 2], [1, 4], [2, 2]]),
        psf_var_mm2=np.ones((3, 3)),
    )
    expected = []
    for k in range(3):
        u, v = np.meshgrid(*[(np.arange(n) - (n - 1) / 2) for n in planes.shape[k]], indexing="ij")
        own = np.stack([u * planes.spacing_mm[k, 0], v * planes.spacing_mm[k, 1], 0 * u], -1).reshape(-1, 3)
        expected.append(own @ rotation[k].T + planes.center_mm[k])
    np.testing.assert_allclose(planes.pixel_world_mm(), np.concatenate(expected), atol=1e-12)
    np.testing.assert_allclose(planes.pixel_world_mm(np.array([7, 0])), np.concatenate(expected)[[7, 0]], atol=1e-12)
