"""The user's mask command: run once per stack, its masks checked, failing or hanging ones refused."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from g3r.acquisition.images import load_volume
from g3r.errors import InputError
from g3r.masking.command import MaskCommand

AFFINE = np.diag([1.0, 1.0, 3.0, 1.0])

GOOD = """
import sys, nibabel, numpy
image = nibabel.Nifti1Image.from_filename(sys.argv[1])
inside = numpy.asarray(image.dataobj) > 5
nibabel.save(nibabel.Nifti1Image(inside.astype(numpy.uint8), image.affine), sys.argv[2])
"""


@pytest.fixture
def stack(tmp_path: Path) -> Path:
    data = np.arange(8 * 8 * 4, dtype=np.float32).reshape(8, 8, 4) % 10
    path = tmp_path / "a stack {mask}.nii.gz"  # the name has a space and a placeholder
    nib.save(nib.Nifti1Image(data, AFFINE), path)
    return path


def command(folder: Path, program: str, timeout_s: float = 60.0) -> MaskCommand:
    script = folder / "masker.py"
    script.write_text(program)
    return MaskCommand(f"'{sys.executable}' '{script}' {{stack}} {{mask}}", timeout_s)


def test_its_mask_is_taken(stack: Path, tmp_path: Path) -> None:
    volume = load_volume(stack)
    made = command(tmp_path, GOOD)
    found = made.mask_of(stack, volume)
    np.testing.assert_array_equal(found.inside, volume.data > 5)
    assert (found.source, found.detail) == ("command", f"{Path(sys.executable).name} masker.py {{stack}} {{mask}}")


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("'/data/Jane Doe/tool.py' --in {stack} --out {mask}", "tool.py --in {stack} --out {mask}"),
        ("tool --weights=/data/doe/net.pth {stack} {mask}", "tool --weights=net.pth {stack} {mask}"),
        ("docker run -v /data/doe/net:/net image {stack} {mask}", "docker run -v net:net image {stack} {mask}"),
        ("sh -c '/data/doe/tool /data/doe/net.pth {stack} {mask}'", "sh -c net.pth {stack} {mask}"),
        (r"'C:\Users\Doe\tool.exe' {stack} {mask}", "C:tool.exe {stack} {mask}"),
    ],
)
def test_records_name_no_folders(line: str, told: str) -> None:
    assert MaskCommand(line).told() == told


@pytest.mark.parametrize(
    ("program", "says"),
    [
        ("import sys; print('reading'); print('no weights found', file=sys.stderr); sys.exit(7)", "code 7: no weights"),
        ("import sys; print('no weights'); sys.exit(7)", "code 7: no weights"),
        ("import sys; sys.exit(1)", "code 1 and said nothing"),
        ("import os; os.kill(os.getpid(), 9)", "exit code -9"),
        ("print('done')", "ended well but wrote no {mask}"),
        (GOOD.replace("> 5", "> 50"), "cannot be used: .*mask is empty"),
        (GOOD.replace("inside.astype", "inside[:4].astype"), "cannot be used: .*differs from that of"),
        (GOOD.replace("image.affine", "image.affine * 3"), "cannot be used: .*voxels off"),
        ("import sys; open(sys.argv[2], 'w').write('a mask')", "cannot be used"),
    ],
    ids=[
        "fails",
        "fails on standard output",
        "fails without a word",
        "killed",
        "writes nothing",
        "empty",
        "other grid",
        "other place",
        "no image",
    ],
)
def test_what_it_does_wrong_is_said(program: str, says: str, stack: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"a stack .*nii.gz: --mask-command .*{says}"):
        command(tmp_path, program).mask_of(stack, load_volume(stack))


@pytest.mark.parametrize(
    "program",
    [
        "import time; time.sleep(60)",
        # its child process keeps the pipe open after the command has ended
        "import subprocess, sys; subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])",
    ],
    ids=["itself", "its child"],
)
def test_one_that_hangs_is_ended(program: str, stack: Path, tmp_path: Path) -> None:
    start = time.monotonic()
    with pytest.raises(InputError, match=r"did not end within 1 s.*--mask-timeout"):
        command(tmp_path, program, timeout_s=1.0).mask_of(stack, load_volume(stack))
    assert time.monotonic() - start < 30


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("tool {stack}", r"no \{mask\} in"),
        ("tool", r"no \{stack\} and no \{mask\}"),
        ("tool '{stack} {mask}", "No closing quotation"),
    ],
)
def test_a_line_that_cannot_work_is_refused_before_it_runs(line: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        MaskCommand(line)


def test_a_program_that_is_not_there(stack: Path) -> None:
    with pytest.raises(InputError, match=r"cannot be started \(No such file.*no-such-masker"):
        MaskCommand("no-such-masker {stack} {mask}").mask_of(stack, load_volume(stack))
