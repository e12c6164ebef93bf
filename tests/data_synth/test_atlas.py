"""Atlas folders: subjects found in them, and volumes in one convention."""

from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from data_synth.atlas import TruthVolume, cropped, find_subjects, load_subject
from data_synth.phantom import Phantom, fetal_brain_phantom
from g3r.errors import InputError
from g3r.geometry import VolumeGrid
from tests.data_synth.atlas_files import SPOT_MM, write_marked_subject

SPACING_MM = 2.0


def test_atlas_conventions_and_patterns(atlas: Path) -> None:
    assert [s.name for s in find_subjects(atlas)] == ["a/week24", "a/week30", "b/ga-27"]
    assert [s.name for s in find_subjects(atlas, include=["a/*"])] == ["a/week24", "a/week30"]
    assert [s.name for s in find_subjects(atlas, exclude=["week*"])] == ["b/ga-27"]
    with pytest.raises(InputError, match=r"none of 3 subjects.*change the patterns"):
        find_subjects(atlas, include=["c/*"])
    with pytest.raises(InputError, match="no such folder"):
        find_subjects(atlas / "nowhere")
    with pytest.raises(InputError, match=r"expected SUBJECT/t2\.nii\.gz"):
        find_subjects(Path(__file__).parent)


def test_atlas_volumes_come_canonical_and_normalised(atlas: Path) -> None:
    for subject in find_subjects(atlas, include=["a/*"]):
        volume = load_subject(subject, SPACING_MM)
        np.testing.assert_allclose(volume.affine[:3, :3], np.eye(3) * SPACING_MM, atol=1e-6)
        assert abs(np.percentile(volume.data[volume.mask], 99.5) - 1) < 0.02
        reference = fetal_brain_phantom(float(subject.name[-2:]), 3.0)
        # the resampled brain lies where the original does
        place = volume.affine[:3, :3] @ np.argwhere(volume.mask).mean(0) + volume.affine[:3, 3]
        expected = reference.affine[:3, :3] @ np.argwhere(reference.mask).mean(0) + reference.affine[:3, 3]
        np.testing.assert_allclose(place, expected, atol=0.3)
        tight = cropped(volume, 2)
        assert tight.mask.sum() == volume.mask.sum()
        place = tight.affine[:3, :3] @ np.argwhere(tight.mask).mean(0) + tight.affine[:3, 3]
        np.testing.assert_allclose(place, expected, atol=0.3)


def seen_at_voxels_of(made: Phantom, volume: TruthVolume, values: NDArray[Any], order: int) -> NDArray[np.float64]:
    """Values [I, J, K] of a loaded volume at the world positions of the phantom's voxels."""
    world = VolumeGrid(made.t2.shape, made.affine).world(np.moveaxis(np.indices(made.t2.shape), 0, -1))
    index = VolumeGrid(volume.data.shape, volume.affine).index(world)
    return map_coordinates(np.asarray(values, np.float64), np.moveaxis(index, -1, 0), order=order, mode="constant")


def center_mm(volume: TruthVolume, where: NDArray[np.bool_]) -> NDArray[np.float64]:
    """World position of the centroid of some voxels."""
    return VolumeGrid(volume.data.shape, volume.affine).world(np.argwhere(where).mean(0))


@pytest.mark.parametrize("axes", ["RAS", "LAS", "LPS", "PSR"])
def test_a_head_is_not_mirrored_whatever_its_header(axes: str, tmp_path: Path) -> None:
    """On its own grid every voxel keeps place, intensity and label; with another voxel size almost."""
    made, labels = write_marked_subject(tmp_path / "week24", 24, axes)
    expected = np.where(made.mask, made.t2 / np.percentile(made.t2[made.mask], 99.5), 0)
    (subject,) = find_subjects(tmp_path)

    same = load_subject(subject, None)
    assert nib.orientations.aff2axcodes(same.affine) == ("R", "A", "S")
    assert same.labels is not None
    np.testing.assert_allclose(seen_at_voxels_of(made, same, same.data, 1), expected, atol=1e-3)
    np.testing.assert_array_equal(seen_at_voxels_of(made, same, same.mask, 0), made.mask)
    np.testing.assert_array_equal(seen_at_voxels_of(made, same, same.labels, 0), labels)

    finer = load_subject(subject, SPACING_MM)
    seen = seen_at_voxels_of(made, finer, finer.data, 1)
    assert np.corrcoef(seen[made.mask], expected[made.mask])[0, 1] > 0.9
    for volume in (same, finer, cropped(finer, 2)):
        assert volume.ventricles is not None
        for marked in (volume.data > 0.7, volume.ventricles):
            np.testing.assert_allclose(center_mm(volume, marked), SPOT_MM, atol=0.6)  # 2 mm voxels; 26 if mirrored
