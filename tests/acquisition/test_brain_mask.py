"""Stacks that need no mask, and stacks that are refused without a mask."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.acquisition.brain_mask import empty_background_mask, required_mask, whole_image
from g3r.acquisition.images import Volume
from g3r.errors import InputError

SHAPE = (40, 40, 12)
AFFINE = np.diag([3.0, 3.0, 5.0, 1.0])
"""The whole image holds 864 ml."""


def ball(radius: float) -> np.ndarray:
    place = np.moveaxis(np.indices(SHAPE), 0, -1) - (np.array(SHAPE) - 1) / 2
    return ((place / [radius, radius, 5.5]) ** 2).sum(-1) < 1


def stack(inside: np.ndarray, around: float = 0.0) -> Volume:
    rng = np.random.default_rng(0)
    data = np.where(inside, rng.uniform(1, 2, SHAPE), around * rng.uniform(0.1, 1, SHAPE))
    return Volume(data.astype(np.float32), AFFINE, "a.nii.gz")


def test_a_brain_before_nothing_is_its_own_mask() -> None:
    found = empty_background_mask(stack(ball(12)))
    assert found is not None
    np.testing.assert_array_equal(found.inside, ball(12))
    assert found.source == "empty background"
    assert required_mask(stack(ball(12))).detail.endswith("ml in the largest piece")


def test_nan_around_a_brain_is_nothing_too() -> None:
    volume = stack(ball(12))
    volume.data[~ball(12)] = np.nan
    found = empty_background_mask(volume)
    assert found is not None
    np.testing.assert_array_equal(found.inside, ball(12))


@pytest.mark.parametrize("beyond", [1e-6, -1e-5, 1e-3, -4e-3])
def test_nearly_nothing_around_a_brain_is_nothing_too(beyond: float) -> None:
    """What interpolation leaves, or the offset of whole numbers; the brain has 1 to 2."""
    volume = stack(ball(12))
    volume.data[~ball(12)] = beyond
    found = required_mask(volume)
    np.testing.assert_array_equal(found.inside, ball(12))
    assert found.source == "empty background"
    np.testing.assert_array_equal(whole_image(volume).inside, ball(12))


@pytest.mark.parametrize(
    "volume",
    [
        stack(ball(12), around=0.2),
        stack(ball(12), around=0.01),
        stack(np.ones(SHAPE, bool)),
        stack(ball(3)),
        Volume(stack(ball(12)).data, np.diag([6.0, 6.0, 10.0, 1.0]), "a.nii.gz"),
        Volume(np.zeros(SHAPE, np.float32), AFFINE, "a.nii.gz"),
    ],
    ids=["tissue around it", "noise around it", "no background", "too small", "too large", "nothing at all"],
)
def test_without_a_mask_anything_else_is_refused(volume: Volume) -> None:
    assert empty_background_mask(volume) is None
    with pytest.raises(InputError, match=r"a\.nii\.gz: no mask says .*--masks.*--mask-command.*--whole-image"):
        required_mask(volume)


def test_a_whole_image_is_taken_at_the_word_of_the_user() -> None:
    volume = stack(ball(12), around=0.2)
    assert whole_image(volume).inside.all()
    with pytest.raises(InputError, match="no positive value"):
        whole_image(Volume(-np.ones(SHAPE, np.float32), AFFINE, "a.nii.gz"))


def test_the_hash_of_a_mask_follows_its_voxels() -> None:
    one, other = (whole_image(stack(ball(radius))) for radius in (12, 11))
    assert one.hash() == whole_image(stack(ball(12))).hash()
    assert one.hash() != other.hash()
