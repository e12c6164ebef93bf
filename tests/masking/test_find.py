"""Given masks, found masks, and stacks that are left out."""

from __future__ import annotations

import argparse
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from g3r.acquisition.brain_mask import FoundMask, MaskSource
from g3r.acquisition.images import Volume
from g3r.cli.infer_task import _load
from g3r.errors import InputError
from g3r.masking.find import MaskedStacks, find_masks

SHAPE = (30, 30, 10)
AFFINE = np.diag([3.0, 3.0, 5.0, 1.0])


def ball(radius: float, center: tuple[float, ...] = (14.5, 14.5, 4.5)) -> np.ndarray:
    place = np.moveaxis(np.indices(SHAPE), 0, -1) - np.array(center)
    return ((place / [radius, radius, 0.4 * radius]) ** 2).sum(-1) < 1


def write(folder: Path, name: str, around: float = 1.0) -> Path:
    data = np.where(ball(9), 5.0, around).astype(np.float32)
    nib.save(nib.Nifti1Image(data, AFFINE), folder / name)
    return folder / name


def find(
    paths: list[Path],
    masks: dict[str, np.ndarray | str],
    given: list[Path | None] | None = None,
    source: MaskSource = "automatic",
) -> MaskedStacks:
    """Find masks with a mask command that looks them up by the name of the stack."""

    def masker(path: object, volume: Volume) -> FoundMask | str:
        found = masks[volume.name]
        return found if isinstance(found, str) else FoundMask(inside=found, source=source)

    return find_masks(paths, given, masker)


@pytest.fixture
def three(tmp_path: Path) -> list[Path]:
    return [write(tmp_path, name) for name in ("a.nii", "b.nii", "c.nii")]


def test_what_is_given_is_taken_and_the_rest_found(three: list[Path], tmp_path: Path) -> None:
    own = tmp_path / "own.nii"
    found = find(three, {"b.nii": ball(9), "c.nii": ball(8.5)}, [own, None, None])
    assert found.kept == [0, 1, 2]
    assert found.masks[0] == own
    assert isinstance(found.masks[2], FoundMask)
    np.testing.assert_array_equal(found.masks[2].inside, ball(8.5))
    assert found.left_out == []


def test_no_masker_is_asked_where_nothing_surrounds_the_brain(tmp_path: Path) -> None:
    found = find([write(tmp_path, "a.nii", around=0)], {})
    assert isinstance(found.masks[0], FoundMask)
    assert found.masks[0].source == "empty background"


def test_a_stack_without_a_head_is_left_out_with_the_reason(three: list[Path]) -> None:
    found = find(three, {"a.nii": ball(9), "b.nii": "no head was found", "c.nii": ball(9)})
    assert found.kept == [0, 2]
    assert found.left_out == ["b.nii: left out, no head was found"]


def test_stacks_of_one_name_are_told_apart_and_keep_their_numbers(tmp_path: Path) -> None:
    """This holds for the message about a stack that is left out and for the names of used stacks."""
    paths = []
    for n, folder in enumerate("abc"):
        (tmp_path / folder).mkdir()
        paths.append(write(tmp_path / folder, "T2.nii", around=1.0 + 0.1 * n))
    found = find(paths, {"T2.nii (stack 1)": "no head", "T2.nii (stack 2)": ball(10), "T2.nii (stack 3)": ball(10)})
    assert found.left_out == ["T2.nii (stack 1): left out, no head"]
    stacks = _load(argparse.Namespace(stacks=paths, thickness=[5.0]), found, None)
    assert [stack.name for stack in stacks] == ["T2.nii (stack 2)", "T2.nii (stack 3)"]


def test_no_head_at_all_is_refused(three: list[Path]) -> None:
    with pytest.raises(InputError, match=r"no brain was found in any stack \(a\.nii.*b\.nii.*--masks"):
        find(three, {path.name: "no head was found" for path in three})


def test_a_mask_of_another_size_than_all_others_is_left_out(three: list[Path]) -> None:
    for odd in (ball(5), ball(14)):
        found = find(three, {"a.nii": ball(9), "b.nii": odd, "c.nii": ball(8.5)})
        assert found.kept == [0, 2]
        assert found.left_out[0].startswith("b.nii: left out, what was found in it")


def test_a_mask_that_is_certain_may_have_any_size(three: list[Path]) -> None:
    masks: dict[str, np.ndarray | str] = {"a.nii": ball(9), "b.nii": ball(5), "c.nii": ball(8.5)}
    assert find(three, masks, source="whole image").kept == [0, 1, 2]


def test_a_head_that_the_field_of_view_cuts_is_smaller_by_right(three: list[Path]) -> None:
    cut = ball(9, (-2.0, 14.5, 4.5))
    assert cut.sum() < ball(9).sum() / 2
    assert find(three, {"a.nii": ball(9), "b.nii": cut, "c.nii": ball(9)}).left_out == []


def test_two_stacks_alone_cannot_say_which_one_is_wrong(three: list[Path]) -> None:
    assert find(three[:2], {"a.nii": ball(9), "b.nii": ball(5)}).kept == [0, 1]


def test_a_file_that_cannot_be_read_is_refused_before_a_mask_is_made(three: list[Path]) -> None:
    asked = []

    def masker(path: object, volume: Volume) -> str:
        asked.append(volume.name)
        return "never"

    with pytest.raises(InputError, match=r"gone\.nii"):
        find_masks([*three, three[0].with_name("gone.nii")], None, masker)
    assert asked == []
