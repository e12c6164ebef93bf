"""A folder of slices as input: pixels are preserved exactly, and positions to 1e-4 mm."""

from __future__ import annotations

import shutil
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import MIN_SLICE_PIXELS, slices_from_stacks
from g3r.errors import InputError
from g3r.geometry import RigidPose
from g3r.registration.atlas_frame import motion_to_headers
from g3r.reuse.finished_run import FinishedRun
from g3r.reuse.slice_input import SliceFolder, load_slice_folder, read_slice_folder
from tests.reuse.slice_writer import AXIAL, CORONAL, SAGITTAL, poses, write_slice, write_stack, write_three

TOLERANCE_MM = 1e-4


def posed(found: SliceFolder) -> Slices:
    """The slices of a folder in their poses, as used by a reconstruction."""
    slices = slices_from_stacks(found.stacks)
    return slices.with_motion(found.poses.motion_of(slices))


def check_files(found: SliceFolder, slices: Slices) -> int:
    """Check every slice against its file: pixels, mask, positions of the corners; returns the number of slices."""
    planes = slices.planes
    for row in range(len(slices)):
        group = found.groups[slices.stack_id[row]]
        one = group.files[int(np.flatnonzero(group.place == slices.slice_index[row])[0])]
        header = nib.Nifti1Image.from_filename(one.path)
        image = np.asarray(header.dataobj)[:, :, 0]
        assert one.mask_path is not None
        mask = np.asarray(nib.Nifti1Image.from_filename(one.mask_path).dataobj)[:, :, 0] > 0
        low, high = np.argwhere(mask).min(0), np.argwhere(mask).max(0)
        box = tuple(slice(a, b + 1) for a, b in zip(low, high, strict=True))
        own = slice(int(planes.offset[row]), int(planes.offset[row + 1]))
        np.testing.assert_array_equal(slices.value[own].reshape(image[box].shape), image[box])
        np.testing.assert_array_equal(slices.mask[own].reshape(image[box].shape), mask[box])
        corners = np.array([[i, j, 0] for i in (low[0], high[0]) for j in (low[1], high[1])])
        here = planes.take([row]).pixel_world_mm().reshape(*image[box].shape, 3)[[0, 0, -1, -1], [0, -1, 0, -1]]
        np.testing.assert_allclose(here, nib.affines.apply_affine(header.affine, corners), atol=TOLERANCE_MM)
    return len(slices)


def n_usable(found: SliceFolder) -> int:
    """Number of slices with enough brain to be used."""
    return sum(int(one.mask.sum()) >= MIN_SLICE_PIXELS for group in found.groups for one in group.files)


@pytest.mark.parametrize("indexed", [True, False])
def test_an_exported_folder_comes_back(exported: Path, run: FinishedRun, tmp_path: Path, indexed: bool) -> None:
    if not indexed:
        shutil.copytree(exported / "slices", tmp_path / "bare")
    found = load_slice_folder(exported if indexed else tmp_path / "bare")
    slices, before = posed(found), run.geometry.slices
    assert check_files(found, slices) == len(before)
    np.testing.assert_array_equal(slices.stack_id, before.stack_id)
    start = (
        before.slice_index * 0
        if indexed
        else [int(before.slice_index[before.stack_id == s][0]) for s in slices.stack_id]
    )
    np.testing.assert_array_equal(slices.slice_index, before.slice_index - start)
    np.testing.assert_allclose(slices.planes.center_mm, before.planes.center_mm, atol=TOLERANCE_MM)
    reach_mm = float((before.planes.shape * before.planes.spacing_mm).max())
    np.testing.assert_allclose(slices.planes.rotation * reach_mm, before.planes.rotation * reach_mm, atol=TOLERANCE_MM)
    np.testing.assert_array_equal(slices.mask, before.mask)
    assert [stack.thickness_mm for stack in found.stacks] == pytest.approx([4.0] * 3, abs=1e-5)
    assert [stack.spacing_mm[2] for stack in found.stacks] == pytest.approx([4.0] * 3, rel=0.02)
    assert ("index.tsv" in found.poses.notes[0]) == indexed


def test_the_nominal_stacks_lie_where_their_slices_are(exported: Path) -> None:
    """A slice moves little relative to its nominal stack, and on average not at all."""
    found = load_slice_folder(exported)
    slices = posed(found)
    common = motion_to_headers(slices)
    np.testing.assert_allclose(common.translation_mm, 0, atol=1e-6)
    np.testing.assert_allclose(common.rotvec_rad(), 0, atol=1e-8)
    moved = slices.planes.pose.apply(slices.planes.corners_mm()) - slices.header_pose.apply(slices.planes.corners_mm())
    assert np.median(np.linalg.norm(moved, axis=-1)) < 1.5  # about the motion of the head; a pixel is 1.5 mm


@pytest.mark.parametrize("gap", ["left-handed", "holes", "stray"])
def test_odd_stacks_keep_their_poses(gap: str, tmp_path: Path, rng: np.random.Generator) -> None:
    affines = poses(CORONAL if gap == "left-handed" else AXIAL, 15, rng)
    if gap == "left-handed":
        assert np.linalg.det(affines[0][:3, :3]) < 0
    write_stack(tmp_path, affines)
    if gap == "stray":
        for name in ("7.nii.gz", "mask_7.nii.gz"):
            image = nib.Nifti1Image.from_filename(tmp_path / name)
            far = image.affine.copy()
            far[:3, 3] += [300, 0, 40]
            nib.save(nib.Nifti1Image(np.asarray(image.dataobj), far), tmp_path / name)
    if gap == "holes":
        for k in (4, 9, 10, 11):
            (tmp_path / f"{k}.nii.gz").unlink()
    found = load_slice_folder(tmp_path)
    (stack,) = found.stacks
    slices = posed(found)
    assert len(found.groups[0].files) == (11 if gap == "holes" else 15)
    assert check_files(found, slices) == n_usable(found)
    assert gap != "stray" or 7 in slices.slice_index
    assert stack.image.shape[2] == 15
    assert max(stack.image.shape[:2]) < 90  # a slice astray does not enlarge the image
    assert stack.spacing_mm[2] == pytest.approx(3.0, abs=0.3)
    others = slices.take(slices.slice_index != 7)
    away_mm = np.linalg.norm(others.planes.center_mm - others.header_pose.translation_mm, axis=1)
    assert np.median(away_mm) < 3


def test_stacks_of_all_kinds_beside_each_other(tmp_path: Path, rng: np.random.Generator) -> None:
    counts = write_three(tmp_path / "slices", rng)
    (tmp_path / "index.tsv").write_text("file\tquality\n0.nii.gz\tgood\n")  # an index of another program
    found = load_slice_folder(tmp_path)
    assert [len(group.files) for group in found.groups] == counts
    assert check_files(found, posed(found)) == sum(
        int(one.mask.sum()) >= MIN_SLICE_PIXELS for group in found.groups for one in group.files
    )
    assert found.poses.notes[0].endswith(
        "stack-0 of 11 slices (0-10), stack-1 of 15 slices (11-25), stack-2 of 13 slices (26-38)"
    )


def test_without_masks_positive_pixels_are_taken(tmp_path: Path, rng: np.random.Generator) -> None:
    write_three(tmp_path / "masked", rng)
    write_three(tmp_path / "bare", np.random.default_rng(20_260_101), masks=False)
    masked, bare = (load_slice_folder(tmp_path / name) for name in ("masked", "bare"))
    for one, other in zip(masked.stacks, bare.stacks, strict=True):
        np.testing.assert_array_equal(one.mask, other.mask)
        assert (one.mask_source, other.mask_source) == ("file", "empty background")
    assert len(masked.poses.notes) == 1
    assert bare.poses.notes[1] == "39 of 39 slices have no mask: their pixels above zero are taken for brain"


def test_headers_of_two_opinions_are_told(tmp_path: Path, rng: np.random.Generator) -> None:
    write_stack(tmp_path, poses(AXIAL, 11, rng))
    written = nib.Nifti1Image.from_filename(tmp_path / "5.nii.gz")
    image = nib.Nifti1Image(np.asarray(written.dataobj), written.affine)
    image.set_qform(np.diag([2.0, 2, 3, 1]), code=1)
    nib.save(image, tmp_path / "5.nii.gz")
    found = load_slice_folder(tmp_path)
    assert found.poses.notes[1].startswith("5.nii.gz: sform and qform differ by up to ")
    assert found.poses.notes[1].endswith("; the sform is used")


def test_a_stack_of_one_slice_and_one_without_brain(tmp_path: Path, rng: np.random.Generator) -> None:
    write_stack(tmp_path, poses(AXIAL, 11, rng))
    blank = np.zeros((30, 34))
    lines = [f"{k}\t0\t{k}" for k in range(11)] + ["11\t4\t0", "12\t7\t0", "13\t7\t1", "20\t7\t2"]
    (middle,) = poses(SAGITTAL, 1, rng)
    write_slice(tmp_path, "11", middle, mask=np.ones((30, 34), bool))
    for name, affine in zip(("12", "13"), poses(CORONAL, 2, rng), strict=True):
        write_slice(tmp_path, name, affine, blank, blank > 0)
    (tmp_path / "index.tsv").write_text("\n".join(["number\tstack\tslice", *lines]))
    found = load_slice_folder(tmp_path)
    assert [stack.name for stack in found.stacks] == ["stack-0", "stack-4"]
    assert found.stacks[1].image.shape[2] == 2  # one of the two is blank
    check_files(found, posed(found))
    assert "stack-7: left out, all its masks are empty" in found.poses.notes


def test_thickness_is_that_of_the_headers_or_given(tmp_path: Path, rng: np.random.Generator) -> None:
    write_three(tmp_path, rng)
    assert [stack.thickness_mm for stack in read_slice_folder(tmp_path)[0]] == pytest.approx([3.0] * 3)
    given = [2.5, 3.5, 4.5]
    stacks, _ = read_slice_folder(tmp_path, given)
    assert [(stack.thickness_mm, stack.origin.thickness_from) for stack in stacks] == [(mm, "option") for mm in given]
    assert [stack.thickness_mm for stack in read_slice_folder(tmp_path, [2.0])[0]] == [2.0] * 3
    with pytest.raises(InputError, match="2 thicknesses for 3 stacks"):
        read_slice_folder(tmp_path, [2.0, 3.0])


def test_poses_are_of_their_slices_alone(tmp_path: Path, rng: np.random.Generator) -> None:
    write_three(tmp_path, rng)
    stacks, given = read_slice_folder(tmp_path)
    slices = slices_from_stacks(stacks)
    backwards = given.motion_of(slices.take(np.arange(len(slices))[::-1]))
    np.testing.assert_array_equal(backwards.rotation, given.motion_of(slices).rotation[::-1])
    few = type(given)(stack_id=given.stack_id[:5], slice_index=given.slice_index[:5], motion=RigidPose.identity(5))
    with pytest.raises(InputError, match="slice 5 of stack 0 has no given pose"):
        few.motion_of(slices)
