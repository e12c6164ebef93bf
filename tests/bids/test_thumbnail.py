"""The small picture of a volume: three sections, the patient's right on the left."""

from __future__ import annotations

import io
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from matplotlib.image import imread

from g3r.bids.thumbnail import thumbnail


def drawn(data: np.ndarray, affine: np.ndarray, folder: Path) -> np.ndarray:
    nib.save(nib.Nifti1Image(data.astype(np.float32), affine), folder / "volume.nii.gz")
    return imread(io.BytesIO(thumbnail(folder / "volume.nii.gz")))[..., 0]


@pytest.mark.parametrize("flipped", [False, True])
def test_sections_are_turned_as_on_the_large_picture(flipped: bool, tmp_path: Path) -> None:
    """A corner that is bright at the right, front and top, for any storage order of voxels."""
    data = np.full((10, 12, 8), 0.5)
    data[7:, 9:, :] = 1.0
    affine = np.eye(4)
    if flipped:
        data, affine = data[::-1], np.diag([-1.0, 1.0, 1.0, 1.0])
    picture = drawn(data, affine, tmp_path)
    assert picture.shape == (12, 10 + 10 + 12)
    assert picture[1, 1] == pytest.approx(1.0)  # axial: right and front are left and up
    assert picture[1, 8] == pytest.approx(0.5, abs=0.01)
    assert picture[10, 1] == pytest.approx(0.5, abs=0.01)
    assert picture[0, 15] == 0.0  # shorter sections have dark rows above and below
    assert picture[6, 15] == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_volume_without_anything_is_dark(value: float, tmp_path: Path) -> None:
    assert not drawn(np.full((3, 4, 5), value), np.eye(4), tmp_path).any()
