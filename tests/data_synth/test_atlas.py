"""Atlas folders: what is found in them, and volumes in one convention."""

from pathlib import Path

import numpy as np
import pytest

from data_synth.atlas import cropped, find_subjects, load_subject
from data_synth.phantom import fetal_brain_phantom
from g3r.errors import InputError

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
