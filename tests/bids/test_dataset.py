"""Sessions of data sets of several kinds, and the masks of their stacks."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from g3r.bids.dataset import find_masks, find_sessions
from g3r.errors import InputError
from tests.bids.data_sets import MASK_ENDS, add_session

STACKS = [("run-1", b"a", b"m"), ("run-2", b"b", b"m")]


def test_with_and_without_sessions(tmp_path: Path) -> None:
    add_session(tmp_path, "02", "b", STACKS)
    add_session(tmp_path, "02", "a", STACKS)
    add_session(tmp_path, "01", None, [("", b"a", b"m")])
    (tmp_path / "sub-03" / "func").mkdir(parents=True)
    found = find_sessions(tmp_path)
    assert [one.stem for one in found] == ["sub-01", "sub-02_ses-a", "sub-02_ses-b"]
    assert [one.folder.as_posix() for one in found] == ["sub-01", "sub-02/ses-a", "sub-02/ses-b"]
    assert [path.name for path in found[0].stacks] == ["sub-01_T2w.nii.gz"]
    assert [one.stem for one in find_sessions(tmp_path, ["sub-02"])] == ["sub-02_ses-a", "sub-02_ses-b"]
    assert [one.stem for one in find_sessions(tmp_path, None, ["b"])] == ["sub-02_ses-b"]


def test_two_runs_of_one_plane_and_what_is_no_stack(tmp_path: Path) -> None:
    names = ("acq-haste_run-1", "acq-haste_run-2", "acq-cor", "rec-other", "part-phase")
    anat = add_session(tmp_path, "01", "1", [(name, b"x", None) for name in names])
    (anat / "sub-09_ses-1_T2w.nii.gz").write_bytes(b"of somebody else")
    (found,) = find_sessions(tmp_path)
    assert [path.name.removeprefix("sub-01_ses-1_") for path in found.stacks] == [
        "acq-cor_T2w.nii.gz", "acq-haste_run-1_T2w.nii.gz", "acq-haste_run-2_T2w.nii.gz"
    ]  # fmt: skip
    assert len(found.left_out) == 3


@pytest.mark.parametrize("pattern", MASK_ENDS)
@pytest.mark.parametrize("session", ["1", None])
def test_masks_under_each_pattern(tmp_path: Path, pattern: str, session: str | None) -> None:
    stacks = [("acq-ax_run-1", b"x", b"m"), ("acq-ax_run-2", b"x", None), ("run-3", b"x", b"m")]
    add_session(tmp_path, "01", session, stacks, pattern)
    add_session(tmp_path, "02", session, STACKS, pattern)
    found = find_sessions(tmp_path, ["01"])[0]
    masks = find_masks(found, tmp_path, tmp_path / "out")
    ends = [mask.name.split("_acq")[-1].split("_run-3")[-1] if mask else None for mask in masks]
    assert ends == [f"-ax_run-1{MASK_ENDS[pattern]}", None, MASK_ENDS[pattern]]
    assert all(mask is None or "sub-01" in mask.name for mask in masks)


def test_a_number_with_zeros_is_the_same_run(tmp_path: Path) -> None:
    anat = add_session(tmp_path, "01", None, [("run-1", b"x", b"m")])
    (anat / "sub-01_run-1_T2w.nii.gz").rename(anat / "sub-01_run-01_T2w.nii.gz")
    assert find_masks(find_sessions(tmp_path)[0], tmp_path, tmp_path / "out")[0] is not None


def test_two_masks_in_one_derivative_are_not_chosen_from(tmp_path: Path) -> None:
    for pattern in ("desc", "plain"):
        add_session(tmp_path, "01", None, [("run-1", b"x", b"m")], pattern)
    (session,) = find_sessions(tmp_path)
    both = (
        r"sub-01_run-1_T2w.nii.gz: has masks derivatives/masks/sub-01/anat/sub-01_run-1_desc-brain_mask.nii.gz and "
        r"derivatives/masks/sub-01/anat/sub-01_run-1_mask.nii.gz; expected one, remove the others"
    )
    with pytest.raises(InputError, match=both):
        find_masks(session, tmp_path, tmp_path / "out")
    with pytest.raises(InputError, match=both):
        find_masks(session, tmp_path, tmp_path / "out", "masks")


@pytest.mark.parametrize("makers", [[{"Name": "g3r"}], [{"Name": "a tool"}, {"Name": "g3r", "Version": "0.1"}]])
def test_masks_that_g3r_found_are_not_the_users(tmp_path: Path, makers: list[dict[str, str]]) -> None:
    add_session(tmp_path, "01", None, STACKS, derivative="g3r-before")
    description = tmp_path / "derivatives" / "g3r-before" / "dataset_description.json"
    (session,) = find_sessions(tmp_path)
    for text in ("{", "[]", '{"GeneratedBy": 1}', '{"GeneratedBy": [{"Name": "a tool"}]}'):
        description.write_text(text)
        assert None not in find_masks(session, tmp_path, tmp_path / "out")
    description.write_text(json.dumps({"GeneratedBy": makers}))
    assert find_masks(session, tmp_path, tmp_path / "out") == [None, None]
    # the user may have corrected them there, and names the derivative
    assert None not in find_masks(session, tmp_path, tmp_path / "out", "g3r-before")
    add_session(tmp_path, "01", None, STACKS, derivative="mine")
    assert all(mask and "mine" in mask.parts for mask in find_masks(session, tmp_path, tmp_path / "out"))


def test_two_derivatives_with_masks_are_not_chosen_from(tmp_path: Path) -> None:
    for name in ("left", "right"):
        add_session(tmp_path, "01", None, STACKS, derivative=name)
    (session,) = find_sessions(tmp_path)
    with pytest.raises(InputError, match=r"derivatives/left and derivatives/right; .*--mask-derivative left"):
        find_masks(session, tmp_path, tmp_path / "out")
    chosen = find_masks(session, tmp_path, tmp_path / "out", "right")
    assert all(mask and "right" in mask.parts for mask in chosen)
    # an earlier output of this command does not count as a second derivative
    assert find_masks(session, tmp_path, tmp_path / "derivatives" / "left") == chosen
    for name in ("middle", ".", "..", "left/sub-01", str(tmp_path)):
        with pytest.raises(InputError, match="is no folder; pass --mask-derivative a name"):
            find_masks(session, tmp_path, tmp_path / "out", name)
    with pytest.raises(InputError, match="is OUT_DIR, too"):
        find_masks(session, tmp_path, tmp_path / "derivatives" / "left", "left")


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no folder"):
        find_sessions(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"no folder sub-\*"):
        find_sessions(tmp_path)
    add_session(tmp_path, "01", "1", STACKS)
    with pytest.raises(InputError, match=r"has no sub-7; found sub-01"):
        find_sessions(tmp_path, ["7"])
    add_session(tmp_path, "02", "2", STACKS)
    (tmp_path / "sub-02" / "ses-3").mkdir()
    assert [one.stem for one in find_sessions(tmp_path, None, ["1", "ses-2"])] == ["sub-01_ses-1", "sub-02_ses-2"]
    with pytest.raises(InputError, match=r"has no ses-9; found ses-1 and 2 more, check the label"):
        find_sessions(tmp_path, None, ["1", "9"])
    with pytest.raises(InputError, match=r"has no ses-1; found ses-2 and 1 more"):
        find_sessions(tmp_path, ["02"], ["1"])
    with pytest.raises(InputError, match="no T2w image for these"):
        find_sessions(tmp_path, None, ["3"])


def test_a_session_without_a_stack_is_not_forgotten(tmp_path: Path) -> None:
    add_session(tmp_path, "01", None, STACKS)
    anat = add_session(tmp_path, "02", "a", [("run-1", b"x", None)])
    (anat / "sub-02_ses-a_run-1_T2w.nii.gz").rename(anat / "sub-02_run-1_T2w.nii.gz")
    found = find_sessions(tmp_path)
    assert [(one.stem, len(one.stacks), one.left_out) for one in found] == [
        ("sub-01", 2, ()), ("sub-02_ses-a", 0, ("sub-02_run-1_T2w.nii.gz",))
    ]  # fmt: skip
    with pytest.raises(InputError, match="holds no T2w image for these participants"):
        find_sessions(tmp_path, ["02"])


def test_masks_behind_a_link_are_found(tmp_path: Path) -> None:
    add_session(tmp_path / "raw", "01", None, STACKS)
    anat = tmp_path / "raw" / "derivatives" / "masks" / "sub-01" / "anat"
    anat.rename(tmp_path / "elsewhere")
    anat.symlink_to(tmp_path / "elsewhere")
    (session,) = find_sessions(tmp_path / "raw")
    assert None not in find_masks(session, tmp_path / "raw", tmp_path / "out")
