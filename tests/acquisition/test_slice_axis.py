"""The axis across the slices: by spacings, header or sidecar, and a remark where none of them tells."""

from __future__ import annotations

import json
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from g3r.acquisition.brain_mask import whole_image
from g3r.acquisition.images import load_volume
from g3r.acquisition.slice_axis import SliceAxis, find_slice_axis
from g3r.acquisition.stacks import load_stack
from g3r.errors import InputError
from tests.acquisition.nifti_files import arrays

ISOTROPIC, THICK, THIN = (1.25, 1.25, 1.25), (0.8, 0.8, 2.2), (1.25, 1.25, 1.0)


def file_of(
    folder: Path, spacing_mm: tuple[float, ...], said: int | None = None, sidecar_mm: float | None = None
) -> Path:
    """A stack with a slice axis in its header, and a sidecar with the distance of slices."""
    image = nib.Nifti1Image(arrays()[0], np.diag([*spacing_mm, 1.0]))
    image.header.set_dim_info(slice=said)
    nib.save(image, folder / "a.nii.gz")
    sidecar = {} if sidecar_mm is None else {"SpacingBetweenSlices": sidecar_mm}
    (folder / "a.json").write_text(json.dumps(sidecar))
    return folder / "a.nii.gz"


def found_in(path: Path) -> SliceAxis:
    return find_slice_axis(path, load_volume(path).grid.spacing_mm)


@pytest.mark.parametrize(
    ("spacing_mm", "said", "sidecar_mm", "expected"),
    [
        (THICK, None, None, 2),
        (np.roll(THICK, 1), None, None, 0),
        (np.roll(THICK, 1), 2, None, 0),  # programs that turn images leave the header's axis as it was
        (THICK, 0, 0.8, 2),  # and this is a sidecar of another image
        (THIN, None, None, 2),
        (ISOTROPIC, 0, None, 0),
        (ISOTROPIC, 1, 1.25, 1),
        (ISOTROPIC, 2, None, 2),
        ((1.3, 1.25, 1.25), None, 1.3, 0),
        ((1.25, 1.2, 1.25), None, 1.2, 1),
        ((1.0, 1.25, 1.25), None, 1.0, 0),
    ],
)
def test_what_tells_the_axis(
    tmp_path: Path, spacing_mm: tuple[float, ...], said: int | None, sidecar_mm: float | None, expected: int
) -> None:
    path = file_of(tmp_path, spacing_mm, said, sidecar_mm)
    found = found_in(path)
    assert (found.axis, found.remark) == (expected, None)


@pytest.mark.parametrize("spacing_mm", [ISOTROPIC, (1.3, 1.25, 1.25), (1.0, 1.25, 1.25), (1.25, 1.25, 1.26)])
@pytest.mark.parametrize("sidecar_mm", [None, 1.25, 3.0])
def test_a_guess_is_remarked_upon(tmp_path: Path, spacing_mm: tuple[float, ...], sidecar_mm: float | None) -> None:
    """Also where the sidecar's distance is that of several axes, or of none."""
    path = file_of(tmp_path, spacing_mm, None, sidecar_mm)
    found = found_in(path)
    assert found.axis == 2
    assert found.remark is not None
    assert found.remark.startswith("slices are taken along axis k of the file: spacings do not tell (1")


def test_a_header_against_the_spacings_is_remarked_upon(tmp_path: Path) -> None:
    path = file_of(tmp_path, (0.9, 1.2, 1.0), said=2)
    found = found_in(path)
    assert found.axis == 1
    assert found.remark is not None
    assert "(0.9 x 1.2 x 1 mm), but its header names axis k (dim_info)" in found.remark


def test_the_stack_is_cut_along_the_axis_and_keeps_the_remark(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    image = arrays()[0]
    stack = load_stack(file_of(tmp_path, ISOTROPIC, said=0), whole_image)
    np.testing.assert_array_equal(stack.image, np.moveaxis(image, 0, 2))
    assert stack.remarks == ()
    stack = load_stack(file_of(tmp_path, ISOTROPIC), whole_image)
    np.testing.assert_array_equal(stack.image, image)
    assert len(stack.remarks) == 1
    assert f"a.nii.gz: {stack.remarks[0]}" in caplog.text


def test_a_sidecar_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    path = file_of(tmp_path, ISOTROPIC)
    (tmp_path / "a.json").write_text("[]")
    with pytest.raises(InputError, match=r"a\.json: holds a list; expected an object"):
        found_in(path)
