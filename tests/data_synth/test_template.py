"""Mean heads, and the heads that they are made from."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import affine_transform, center_of_mass

from data_synth.atlas import find_subjects
from data_synth.heads import PhantomSubject, load_head
from data_synth.template import atlas_templates
from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.errors import InputError
from g3r.geometry import VolumeGrid


@pytest.fixture(scope="module")
def template() -> AtlasTemplate:
    return atlas_templates([PhantomSubject("a", 25.0, 1), PhantomSubject("b", 31.5, 2)], 3.0, weeks=(25, 31, 37))


def test_ages_without_a_subject_are_left_out(template: AtlasTemplate) -> None:
    assert template.weeks.tolist() == [25, 31]
    assert len(template.volume) == 2


def test_symmetric_centred_and_normalised(template: AtlasTemplate) -> None:
    np.testing.assert_allclose(template.volume, template.volume[:, ::-1], atol=1e-6)
    np.testing.assert_allclose(template.grid.center_mm, 0, atol=1e-9)
    for head in template.volume:
        centroid = template.grid.world(center_of_mass(head > 0))
        assert np.abs(centroid).max() < 1.5  # half a voxel: the mask's centroid is at the origin
        assert np.percentile(head[head > 0], 99.5) == pytest.approx(1, abs=1e-3)


def test_older_heads_are_larger(template: AtlasTemplate) -> None:
    young, old = (template.volume > 0).sum((1, 2, 3))
    assert old > 1.2 * young


def test_a_head_stands_on_its_centroid() -> None:
    head = load_head(PhantomSubject("a", 25.0, 1), 2.0)
    grid = VolumeGrid(head.data.shape, head.affine)
    np.testing.assert_allclose(grid.world(center_of_mass(head.mask)), 0, atol=1e-6)
    assert (head.data[~head.mask] == 0).all()


def test_no_subject_near_the_ages() -> None:
    with pytest.raises(InputError, match="none of 1 subjects"):
        atlas_templates([PhantomSubject("a", 25.0, 1)], 3.0, weeks=(37,))


def test_a_real_atlas_has_its_mid_sagittal_plane_in_the_middle(shared_data: Path) -> None:
    subjects = find_subjects(shared_data / "atlas", include=["sta29", "sb2[78]-operated"])
    for subject in subjects:
        head = load_head(subject, 2.0)
        alike = []
        for plane_mm in (-2.0, 0.0, 2.0):
            mirrored = np.diag([-1.0, 1.0, 1.0, 1.0])
            mirrored[0, 3] = 2 * plane_mm
            index = np.linalg.inv(head.affine) @ mirrored @ head.affine
            other = affine_transform(head.data, index[:3, :3], index[:3, 3], order=1)
            alike.append(np.corrcoef(head.data[head.mask], other[head.mask])[0, 1])
        assert alike[1] > max(alike[0], alike[2]) + 0.3, subject.name
