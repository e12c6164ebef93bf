"""Stacks from files: axes, thickness, masks, and every refusal."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g3r.acquisition.brain_mask import whole_image
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack, load_stack, load_stacks
from g3r.errors import InputError
from tests.acquisition.nifti_files import AXES, affine_of, arrays, write


def test_four_dimensions_with_one_frame(tmp_path: Path) -> None:
    image, mask = arrays()
    path = write(tmp_path / "a.nii.gz", image[..., None], affine_of(AXES["RAS"]))
    mask_path = write(tmp_path / "m.nii.gz", mask[..., None].astype(np.uint8), affine_of(AXES["RAS"]))
    stack = load_stack(path, mask_path)
    np.testing.assert_array_equal(stack.image, image)
    np.testing.assert_array_equal(stack.mask, mask)


def test_thickness_is_not_the_distance_of_slices(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    image, mask = arrays()
    path = write(tmp_path / "a.nii.gz", image, affine_of(AXES["RAS"]))
    mask_path = write(tmp_path / "m.nii.gz", mask.astype(np.uint8), affine_of(AXES["RAS"]))
    with caplog.at_level("INFO"):
        by_header = load_stack(path, mask_path)
    assert by_header.thickness_mm == pytest.approx(3.0)
    assert "thickness" in caplog.text
    given = load_stack(path, mask_path, 2.2)
    assert given.thickness_mm == 2.2
    assert given.spacing_mm[2] == pytest.approx(3.0)
    normal_sigma = np.sqrt(slices_from_stacks([given]).planes.psf_var_mm2[0, 2])
    assert normal_sigma == pytest.approx(2.2 / 2.3548, rel=1e-4)


def test_a_thickness_below_the_pixels_is_doubtful_whatever_axis_the_slices_are_on(tmp_path: Path) -> None:
    image, mask = arrays(shape=(6, 14, 11))
    path = write(tmp_path / "a.nii.gz", image * mask, affine_of(AXES["RAS"], spacing=(3.0, 0.8, 0.9)))
    assert load_stack(path, whole_image, 1.0).remarks == ()
    (remark,) = load_stack(path, whole_image, 0.7).remarks
    assert remark == "thickness 0.7 mm is less than the pixels' 0.8 x 0.9 mm; check --thickness"


def test_a_mask_may_be_found_by_any_function(tmp_path: Path) -> None:
    image, mask = arrays()
    stack = load_stack(write(tmp_path / "a.nii.gz", image * mask, affine_of(AXES["RAS"])), whole_image)
    np.testing.assert_array_equal(stack.mask, mask)
    assert stack.mask_source == "whole image"


def test_stacks_whose_files_have_one_name_are_told_apart_by_their_numbers(tmp_path: Path) -> None:
    image, mask = arrays()
    paths = []
    for n, name in enumerate(("ax/T2.nii.gz", "cor/T2.nii.gz", "sag.nii.gz")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        paths.append(write(tmp_path / name, (image + n) * mask, affine_of(AXES["RAS"])))
    stacks = load_stacks(paths, [whole_image] * 3)
    assert [stack.name for stack in stacks] == ["T2.nii.gz (stack 1)", "T2.nii.gz (stack 2)", "sag.nii.gz"]
    write(paths[1], image * mask, affine_of(AXES["RAS"]))
    with pytest.raises(InputError, match=r"^T2\.nii\.gz \(stack 2\): holds the same image as T2\.nii\.gz \(stack 1\)"):
        load_stacks(paths, [whole_image] * 3)


def test_a_mask_as_in_the_file_is_on_the_grid_of_the_file(tmp_path: Path) -> None:
    image, mask = (np.moveaxis(array, 2, 0) for array in arrays())
    affine = affine_of(AXES["RAS"])
    affine[:3, :3] = affine[:3, [2, 0, 1]]
    stack = load_stack(write(tmp_path / "a.nii.gz", image * mask, affine), whole_image)
    assert stack.axes.slice_axis == 0
    np.testing.assert_array_equal(stack.mask_as_in_file, mask)
    np.testing.assert_array_equal(stack.affine_as_in_file, affine.astype(np.float32))


def test_a_stack_without_a_positive_value_and_without_mask_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no positive value"):
        load_stack(write(tmp_path / "a.nii.gz", -arrays()[0], affine_of(AXES["RAS"])), whole_image)


SHEARED = affine_of(np.array([[1, 0.2, 0], [0, 1, 0], [0, 0, 1]]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": np.zeros((3, 3), np.float32)}, "expected a 3D stack"),
        ({"mask": np.ones((3, 3, 3), bool)}, "mask has shape"),
        ({"image": arrays()[0][:, :, :1], "mask": arrays()[1][:, :, :1]}, "holds 1 slice"),
        ({"affine": np.full((4, 4), np.nan)}, "bad header"),
        ({"affine": np.diag([1.0, 0, 1, 1])}, "bad header.*singular"),
        ({"affine": SHEARED}, "sheared"),
        ({"thickness_mm": 0.0}, "slice thickness 0 mm.*--thickness"),
        ({"thickness_mm": -2.0}, "slice thickness -2 mm"),
        ({"thickness_mm": 50.0}, "slice thickness 50 mm"),
        ({"thickness_mm": float("nan")}, "slice thickness nan"),
        ({"mask": np.zeros((14, 11, 6), bool)}, "mask is empty"),
        ({"image": np.full((14, 11, 6), np.nan, np.float32)}, "not finite"),
        ({"image": np.full((14, 11, 6), np.inf, np.float32)}, "not finite"),
        ({"image": np.full((14, 11, 6), 7, np.float32)}, "every value inside the mask is 7"),
    ],
)
def test_unusable_stacks_are_refused(change: dict[str, Any], message: str) -> None:
    image, mask = arrays()
    good: dict[str, Any] = {
        "image": image,
        "mask": mask,
        "affine": affine_of(AXES["RAS"]),
        "thickness_mm": 3.0,
        "name": "a.nii",
    }
    Stack(**good)
    with pytest.raises(InputError, match=message) as caught:
        Stack(**(good | change))
    assert str(caught.value).startswith("a.nii: ")


def test_an_image_without_its_mean_is_refused(tmp_path: Path) -> None:
    image, mask = arrays()
    shifted = image - image[mask > 0].mean()
    affine = affine_of(AXES["RAS"])
    paths = write(tmp_path / "a.nii.gz", shifted, affine), write(tmp_path / "m.nii.gz", mask.astype(np.uint8), affine)
    with pytest.raises(InputError, match=r"a\.nii\.gz: \d+ % of the values inside the mask are negative"):
        load_stack(*paths, 2.5)
