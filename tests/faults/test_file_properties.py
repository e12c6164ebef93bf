"""Properties for any grid (a stack survives its file) and any header (a dry run succeeds or ends in one line)."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import nibabel as nib
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st
from nibabel.arrayproxy import ArrayProxy
from scipy.spatial.transform import Rotation

from g3r.acquisition.images import save_volume
from g3r.acquisition.stacks import Stack, load_stack
from g3r.cli.infer import main
from g3r.geometry import VolumeGrid
from tests.faults.commands import assert_refused, run
from tests.faults.fuzz_headers import FIELDS, NUMBERS
from tests.faults.nifti_files import ball, image, write, write_raw
from tests.tally import Tally

FIELD_EPSILON = float(np.finfo(np.float32).eps)
"""Relative precision of affines, which NIfTI-1 stores as float32."""

quick = settings(
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    derandomize=True,
    phases=(Phase.explicit, Phase.generate),  # shrinking takes minutes, and these cases are small
)


@st.composite
def stacks(draw: st.DrawFn) -> Stack:
    """Any stack: oblique, left-handed, with any slice thickness and spacing, far from the origin."""
    shape = draw(st.tuples(st.integers(4, 12), st.integers(4, 12), st.integers(2, 6)))
    turn = Rotation.from_rotvec(draw(st.tuples(*[st.floats(-3.1, 3.1)] * 3))).as_matrix()
    in_plane = draw(st.tuples(st.floats(0.3, 2.0), st.floats(0.3, 2.0)))
    distance = draw(st.floats(1.2, 4.0)) * max(in_plane)
    signs = draw(st.tuples(*[st.sampled_from([-1.0, 1.0])] * 3))
    affine = np.eye(4)
    affine[:3, :3] = turn * (np.array([*in_plane, distance]) * signs)
    affine[:3, 3] = draw(st.tuples(*[st.floats(-1e4, 1e4)] * 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    scale = 10.0 ** draw(st.integers(-6, 6))
    # clear of zero: what is nearly zero becomes zero, and a zero in so small a mask is cut from it
    data = ((np.maximum(np.abs(rng.normal(size=shape)), 0.02) + draw(st.floats(0, 3))) * scale).astype(np.float32)
    data.flat[0] = scale  # at least one positive value
    data.flat[-1] = -scale  # and a negative one beside the brain
    mask = rng.random(shape) < draw(st.floats(0.2, 1.0))
    mask.flat[:2], mask.flat[-1] = True, False
    return Stack(image=data, mask=mask, affine=affine, thickness_mm=draw(st.floats(0.1, 20.0)), name="any")


def written_and_read(stack: Stack, folder: Path, order: tuple[int, ...], ending: str) -> Stack:
    """A stack after writing to a file with another order of axes, and reading."""
    affine = stack.affine.copy()
    affine[:3, :3] = affine[:3, order]
    save_volume(folder / f"image{ending}", stack.image.transpose(order), affine)
    save_volume(folder / f"mask{ending}", stack.mask.transpose(order), affine)
    return load_stack(folder / f"image{ending}", folder / f"mask{ending}", stack.thickness_mm)


@given(stacks(), st.permutations(range(3)), st.sampled_from([".nii", ".nii.gz"]))
@settings(quick, max_examples=100)
def test_a_stack_survives_its_file(tally: Tally, stack: Stack, order: list[int], ending: str) -> None:
    """Values and masks are bit-identical, positions agree to float32 rounding, for any slice axis."""
    with tally.case(), TemporaryDirectory() as folder:
        back = written_and_read(stack, Path(folder), tuple(order), ending)
        np.testing.assert_array_equal(back.axes.to_file(back.image), stack.image.transpose(order))
        np.testing.assert_array_equal(back.mask_as_in_file, stack.mask.transpose(order))
        assert back.thickness_mm == stack.thickness_mm
        in_file = VolumeGrid(back.mask_as_in_file.shape, back.affine_as_in_file)
        turned = back.axes.grid_from_file(in_file)
        moved = np.linalg.norm(back.grid.world(turned.corner_index) - turned.world(turned.corner_index), axis=1)
        reach_mm = np.linalg.norm(turned.world(turned.corner_index) - turned.center_mm, axis=1)
        assert (moved < 0.01 + 2e-4 * reach_mm).all()  # the precision of reading (`settled`)
        corner = np.array(stack.image.shape) - 1
        for index in (np.zeros(3), corner, corner / 2):
            reach = np.abs(stack.affine[:3, :3]) @ corner + np.abs(stack.affine[:3, 3])
            error = np.abs(in_file.world(index[order]) - stack.grid.world(index))
            assert (error <= 2 * FIELD_EPSILON * reach + 1e-12).all(), error


@given(stacks(), st.sampled_from(["<i2", "<u2", "<u1"]))
@settings(quick, max_examples=50)
def test_whole_numbers_with_a_scaling_are_right_to_rounding(tally: Tally, stack: Stack, dtype: str) -> None:
    """Integers as stored by scanners are right within half a step of the slope that nibabel chooses."""
    with tally.case(), TemporaryDirectory() as folder:
        path = Path(folder) / "image.nii.gz"
        written = nib.Nifti1Image(stack.image, stack.affine)
        written.set_data_dtype(np.dtype(dtype))
        nib.save(written, path)
        stored = nib.Nifti1Image.from_filename(path).dataobj
        assert isinstance(stored, ArrayProxy)
        slope = abs(float(stored.slope))
        save_volume(path.with_name("mask.nii"), stack.mask, stack.affine)
        back = load_stack(path, path.with_name("mask.nii"), stack.thickness_mm)
        largest = float(np.abs(stack.image).max())
        assert np.abs(back.axes.to_file(back.image) - stack.image).max() <= 0.51 * slope + 4 * FIELD_EPSILON * largest


numbers = st.one_of(st.sampled_from(NUMBERS), st.floats(), st.integers(-(2**31), 2**31 - 1))
headers = st.dictionaries(
    st.sampled_from([name for name in FIELDS if name not in ("magic", "descrip")]),
    st.lists(numbers, min_size=1, max_size=8),
    max_size=4,
)


def fitted(fields: dict[str, list[float]]) -> dict[str, Any]:
    """Numbers converted to the types of the header's fields."""
    block = np.zeros((), nib.Nifti1Header.template_dtype)
    made = {}
    for name, values in fields.items():
        field = block[name]
        few = np.resize(np.array(values, dtype=object), field.shape or (1,))
        if field.dtype.kind == "f":
            with np.errstate(all="ignore"):
                whole = few.astype(np.float64).astype(np.float32)
        else:
            low, high = np.iinfo(field.dtype).min, np.iinfo(field.dtype).max
            whole = np.array([int(min(max(x, low), high)) if x == x else 0 for x in few], field.dtype)
        made[name] = whole if field.shape else whole[0]
    return made


def dry_run(fields: dict[str, list[float]], ending: str, role: str, tally: Tally) -> None:
    with tally.case() as case, TemporaryDirectory() as name:
        folder = Path(name)
        bad = write_raw(folder / f"bad{ending}", ball() if role == "mask" else image(), fitted(fields))
        words = ["--stacks", bad, "--whole-image"]
        if role == "mask":
            words = ["--stacks", write(folder / "stack.nii"), "--masks", bad]
        outcome = run(main, [*words, "--output", folder / "out", "--dry-run"], folder)
        if outcome.code == 0:
            assert "thickness" in outcome.out
            assert outcome.changed == set()
        else:
            assert_refused(outcome, "g3r-infer", "", "")
            assert "bad.nii" in outcome.err or "stack.nii" in outcome.err
            case.refused()


@pytest.mark.usefixtures("networks_once")
@given(headers, st.sampled_from([".nii", ".nii.gz"]), st.sampled_from(["stack", "mask"]))
@example({"srow_y": [100.0, 1e-30]}, ".nii.gz", "stack")  # axes that become singular by rounding
@settings(quick, max_examples=150)
def test_a_dry_run_of_any_header(tally: Tally, fields: dict[str, list[float]], ending: str, role: str) -> None:
    dry_run(fields, ending, role, tally)


@pytest.mark.faults
@pytest.mark.usefixtures("networks_once")
@given(headers, st.sampled_from([".nii", ".nii.gz"]), st.sampled_from(["stack", "mask"]))
@settings(quick, max_examples=1000)
def test_a_dry_run_of_any_header_at_length(
    tally: Tally, fields: dict[str, list[float]], ending: str, role: str
) -> None:
    dry_run(fields, ending, role, tally)
