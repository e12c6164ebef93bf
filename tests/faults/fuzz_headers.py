"""Random damage to NIfTI files. Each case must load as a complete stack or raise one `InputError`.

`python -m tests.faults.fuzz headers 10000 1` runs the cases in a process with bounded memory (fuzz.py).
"""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np

from g3r.acquisition.brain_mask import whole_image
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack, load_stack
from tests.faults.nifti_files import ball, image, raw, write

SHAPE = (14, 12, 5)

NUMBERS = (
    0,
    1,
    -1,
    2,
    3,
    7,
    8,
    255,
    348,
    352,
    353,
    540,
    1000,
    32767,
    -32768,
    65535,
    2**31 - 1,
    -(2**31),
    2**32,
    2**62,
    -(2**63),
    0.5,
    1e-3,
    1e-30,
    1e-45,
    1e30,
    3.4e38,
    -3.4e38,
    np.nan,
    np.inf,
    -np.inf,
    16,
    64,
    128,
    512,
    1792,
    2304,
)
"""Values for header fields: limits of their types, codes of data types, values that are not numbers."""

FIELDS = (
    "sizeof_hdr",
    "dim",
    "intent_code",
    "datatype",
    "bitpix",
    "slice_start",
    "pixdim",
    "vox_offset",
    "scl_slope",
    "scl_inter",
    "slice_end",
    "slice_code",
    "xyzt_units",
    "cal_max",
    "cal_min",
    "toffset",
    "qform_code",
    "sform_code",
    "quatern_b",
    "quatern_c",
    "quatern_d",
    "qoffset_x",
    "qoffset_y",
    "qoffset_z",
    "srow_x",
    "srow_y",
    "srow_z",
    "magic",
    "dim_info",
    "descrip",
)

ROLES = ("stack", "stack with mask", "mask")


class HeaderFuzz:
    """Cases by number; the same seed and number give the same file.

    Args:
        folder: for the files.
        seed: of the damage.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.seed = folder, seed
        self.stack = write(folder / "stack.nii.gz", image(1, SHAPE))
        self.mask = write(folder / "mask.nii.gz", ball(SHAPE))

    def run(self, number: int) -> None:
        """One case.

        Raises:
            InputError: the file was refused.
            AssertionError: the file was accepted but the result is not a valid stack.
        """
        rng = np.random.default_rng([self.seed, number])
        role = ROLES[rng.choice(3, p=(0.6, 0.2, 0.2))]
        path = self.file(rng, role == "mask", number)
        try:
            if role == "mask":
                stack = load_stack(self.stack, path)
            else:
                stack = load_stack(path, self.mask if role == "stack with mask" else whole_image)
            check_stack(stack)
        finally:
            path.unlink()

    def file(self, rng: np.random.Generator, is_mask: bool, number: int) -> Path:
        """A damaged file."""
        content = bytearray(damaged_nifti(rng, is_mask))
        if rng.random() < 0.3:
            content = damaged_bytes(rng, content, 600)
        packed = rng.random() < 0.4
        if packed:
            content = bytearray(gzip.compress(bytes(content), 1))
            if rng.random() < 0.3:
                content = damaged_bytes(rng, content, len(content))
        path = self.folder / f"case-{number}.nii{'.gz' if packed else ''}"
        path.write_bytes(content)
        return path


def damaged_nifti(rng: np.random.Generator, is_mask: bool) -> bytes:
    """A file with up to four header fields, or entries of them, set to meaningful numbers."""
    data = ball(SHAPE) if is_mask else image(int(rng.integers(9)), SHAPE)
    if rng.random() < 0.2:
        data = data.astype(rng.choice(["<i2", "<u2", "<f8", "<i4", "<u1"]))
    version = 2 if rng.random() < 0.25 else 1
    extensions = ((6, b"a comment"),) if rng.random() < 0.2 else ()
    whole = bytearray(raw(data, version=version, extensions=extensions))
    head = 348 if version == 1 else 540
    block = np.frombuffer(bytearray(whole[:head]), _layout(version))[0]
    for _ in range(int(rng.integers(0, 5))):
        name = FIELDS[rng.integers(len(FIELDS))]
        if name in ("magic", "descrip"):
            block[name] = rng.bytes(block[name].nbytes)
            continue
        value = np.asarray(block[name]).copy()
        flat = value.reshape(-1)
        number = NUMBERS[rng.integers(len(NUMBERS))]
        with np.errstate(all="ignore"):
            flat[rng.integers(flat.size)] = _fitting(number, flat.dtype)
        block[name] = value if value.ndim else flat[0]
    return block.tobytes() + bytes(whole[head:])


def damaged_bytes(rng: np.random.Generator, content: bytearray, reach: int) -> bytearray:
    """Bytes overwritten, inverted, truncated, removed or inserted near the beginning."""
    kind, n = rng.integers(5), len(content)
    at = int(rng.integers(max(min(reach, n), 1)))
    few = int(rng.integers(1, 17))
    if kind == 0:
        content[at : at + few] = rng.bytes(few)
    elif kind == 1 and n:
        content[min(at, n - 1)] ^= 1 << int(rng.integers(8))
    elif kind == 2:
        del content[int(rng.integers(n + 1)) :]
    elif kind == 3:
        del content[at : at + few]
    else:
        content[at:at] = rng.bytes(few)
    return content


def check_stack(stack: Stack) -> None:
    """Assert that an accepted stack is valid: finite values, a proper grid, slices."""
    assert stack.image.dtype == np.float32
    assert stack.image.ndim == 3
    assert stack.image.size <= 10_000, "more voxels than any of these files holds"
    assert np.isfinite(stack.image).all()
    assert stack.mask.shape == stack.image.shape
    assert stack.mask.any()
    assert np.isfinite(stack.affine).all()
    assert 0.05 <= stack.spacing_mm.min() <= stack.spacing_mm.max() <= 50
    slices = slices_from_stacks([stack])
    assert np.isfinite(slices.value).all()
    assert np.isfinite(slices.planes.center_mm).all()
    np.testing.assert_allclose(np.linalg.det(slices.planes.rotation), 1, atol=1e-9)


def _layout(version: int) -> np.dtype:
    import nibabel as nib

    kind = nib.Nifti1Header if version == 1 else nib.Nifti2Header
    return kind.template_dtype.newbyteorder("<")


def _fitting(number: float, dtype: np.dtype) -> float:
    """A number converted to the field's type; integers wrap around."""
    if dtype.kind == "f":
        return float(number)
    whole = int(number) if np.isfinite(number) else -1
    bits = 8 * dtype.itemsize
    wrapped = whole % 2**bits
    return wrapped - 2**bits if dtype.kind == "i" and wrapped >= 2 ** (bits - 1) else wrapped
