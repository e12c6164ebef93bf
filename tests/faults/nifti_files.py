"""Small NIfTI files: good ones, and ones with arbitrary headers."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np

SHAPE = (24, 20, 8)
AFFINE = np.array([[1.0, 0, 0, -12], [0, 1, 0, -10], [0, 0, 3, -12], [0, 0, 0, 1]])


def image(seed: int = 0, shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    """An image of distinct positive values, float32."""
    return np.random.default_rng(seed).uniform(100, 1000, shape).astype(np.float32)


def ball(shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    """A ball-shaped mask with a margin to the border, uint8."""
    index = np.stack(np.meshgrid(*[np.linspace(-1, 1, n) for n in shape[:3]], indexing="ij"), -1)
    return ((index**2).sum(-1) < 0.8).astype(np.uint8)


def write(path: Path, data: np.ndarray | None = None, affine: np.ndarray | None = None) -> Path:
    """Write a good file."""
    nib.save(nib.Nifti1Image(image() if data is None else data, AFFINE if affine is None else affine), path)
    return path


def raw(
    data: np.ndarray | None = None,
    fields: Mapping[str, Any] | None = None,
    *,
    affine: np.ndarray | None = None,
    version: int = 1,
    extensions: tuple[tuple[int, bytes], ...] = (),
) -> bytes:
    """The bytes of an uncompressed file with header fields set to arbitrary values, unchecked."""
    kind = nib.Nifti1Image if version == 1 else nib.Nifti2Image
    given = image() if data is None else data
    made = kind(given, AFFINE if affine is None else affine, dtype=given.dtype)
    for code, content in extensions:
        made.header.extensions.append(nib.nifti1.Nifti1Extension(code, content))
    whole = made.to_bytes()
    head = 348 if version == 1 else 540
    block = np.frombuffer(bytearray(whole[:head]), made.header.template_dtype.newbyteorder("<"))[0]
    for name, value in (fields or {}).items():
        with np.errstate(all="ignore"):
            block[name] = value
    return block.tobytes() + whole[head:]


def write_raw(path: Path, *arguments: Any, cut: Callable[[bytes], bytes] = bytes, **options: Any) -> Path:
    """Write `raw` as a file, compressed if its name says so; `cut` damages the bytes before compression."""
    content = cut(raw(*arguments, **options))
    path.write_bytes(gzip.compress(content, 1) if path.name.lower().endswith(".gz") else content)
    return path
