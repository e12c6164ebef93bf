"""Atlas folders: any tree of NIfTI volumes with masks, read as normalised RAS volumes at one voxel size."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, gaussian_filter

from g3r.acquisition.images import load_mask, load_volume
from g3r.errors import InputError

logger = logging.getLogger(__name__)

IMAGE_NAMES = ("t2", "T2", "T2w", "image", "volume", "truth")
MASK_ENDINGS = ("_mask", "-mask")
VENTRICLES = 2
"""Label of the ventricles in a `labels` file next to the image, as in the atlases of Fidon et al. (2021)."""
EXTENSIONS = (".nii.gz", ".nii")


@dataclass(frozen=True)
class AtlasSubject:
    """Paths of a subject's files; `name` is its path relative to the atlas folder, with `/`."""

    name: str
    image: Path
    mask: Path
    labels: Path | None = None


@dataclass(frozen=True, kw_only=True)
class TruthVolume:
    """A volume to be sliced.

    Args:
        name: of the subject.
        data: [I, J, K] float32; the 99.5th percentile in the mask is 1, outside it is zero.
        mask: [I, J, K] the head.
        affine: [4, 4] RAS+ mm from index.
        labels: [I, J, K] uint8 tissues, where they are known.
        ventricles: [I, J, K], where they are known.
    """

    name: str
    data: NDArray[np.float32]
    mask: NDArray[np.bool_]
    affine: NDArray[np.float64]
    labels: NDArray[np.uint8] | None = None
    ventricles: NDArray[np.bool_] | None = None


def find_subjects(folder: str | Path, include: Sequence[str] = (), exclude: Sequence[str] = ()) -> list[AtlasSubject]:
    """Subjects (volumes with masks) below a folder, sorted by name.

    Recognised are SUBJECT/t2.nii.gz with SUBJECT/mask.nii.gz, and X.nii.gz with X_mask.nii.gz or
    X-mask.nii.gz. SUBJECT/labels.nii.gz, if it exists, holds the tissues.

    Args:
        folder: the root of the tree.
        include: glob patterns, one of which must match; an empty list takes all. A pattern is compared with the
            subject's path relative to the folder and with the last part of that path.
        exclude: glob patterns, none of which may match.

    Raises:
        InputError: no such folder, or no subject in it passes the patterns.
    """
    root = Path(folder)
    if not root.is_dir():
        raise InputError(f"{root}: no such folder; expected a tree of NIfTI volumes with masks")
    found = {}
    for extension in EXTENSIONS:
        for mask in sorted(root.rglob(f"*mask{extension}")):
            image, name = _image_of(mask, extension, root)
            if image is not None and name not in found:
                labels = mask.with_name(f"labels{extension}")
                known = labels if labels.exists() and mask.name == f"mask{extension}" else None
                found[name] = AtlasSubject(name, image, mask, known)
    if not found:
        raise InputError(
            f"{root}: no volume with a mask found; expected SUBJECT/t2.nii.gz with SUBJECT/mask.nii.gz, "
            "or X.nii.gz with X_mask.nii.gz"
        )
    chosen = [
        found[name]
        for name in sorted(found)
        if (not include or _matches(name, include)) and not _matches(name, exclude)
    ]
    if not chosen:
        raise InputError(
            f"{root}: none of {len(found)} subjects (such as {min(found)}) passes include {list(include)} "
            f"and exclude {list(exclude)}; change the patterns"
        )
    return chosen


def load_subject(subject: AtlasSubject, spacing_mm: float | None) -> TruthVolume:
    """Read a subject as a normalised, masked volume with isotropic voxels and the axis order closest to RAS.

    Args:
        subject: its files.
        spacing_mm: isotropic voxel size; None keeps the file's own grid.

    Raises:
        InputError: unreadable files, a mask on another grid, an empty mask, or an image without contrast.
    """
    volume = load_volume(subject.image)
    mask = load_mask(subject.mask, volume)
    data = np.nan_to_num(volume.data, posinf=0.0, neginf=0.0)
    to_ras = nib.orientations.io_orientation(volume.affine)
    affine = volume.affine @ nib.orientations.inv_ornt_aff(to_ras, data.shape)
    data = nib.orientations.apply_orientation(data, to_ras)
    mask = nib.orientations.apply_orientation(mask, to_ras).astype(bool)

    labels = None
    if subject.labels is not None:
        of_file = load_volume(subject.labels)
        if of_file.data.shape != volume.data.shape:
            raise InputError(
                f"{subject.labels}: shape {of_file.data.shape}, but the image has {volume.data.shape}; "
                "expected labels on the image's grid"
            )
        labels = nib.orientations.apply_orientation(np.rint(of_file.data), to_ras).astype(np.uint8)

    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if spacing_mm is not None and np.abs(spacing - spacing_mm).max() > 1e-3:
        data, mask, labels, affine = _resampled(data, mask, labels, affine, spacing, spacing_mm)
        if not mask.any():
            raise InputError(f"{subject.mask}: mask is empty at {spacing_mm:g} mm; use a finer spacing")
    bright = float(np.percentile(data[mask], 99.5))
    if not bright > 0:
        raise InputError(f"{subject.image}: 99.5th percentile in the mask is {bright:g}; expected a positive image")
    data = np.where(mask, np.clip(data / bright, 0, None), 0).astype(np.float32)
    ventricles = None if labels is None else (labels == VENTRICLES) & mask
    return TruthVolume(name=subject.name, data=data, mask=mask, affine=affine, labels=labels, ventricles=ventricles)


def cropped(volume: TruthVolume, margin_voxels: int) -> TruthVolume:
    """The volume cut, or padded with zeros, to its mask's bounding box plus a margin."""
    inside = np.argwhere(volume.mask)
    low, high = inside.min(0), inside.max(0) + 1
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    affine = volume.affine.copy()
    affine[:3, 3] += affine[:3, :3] @ (low - margin_voxels)

    def cut(array: NDArray[Any] | None) -> Any:
        return None if array is None else np.pad(array[box], margin_voxels)

    return TruthVolume(
        name=volume.name,
        data=cut(volume.data),
        mask=cut(volume.mask),
        affine=affine,
        labels=cut(volume.labels),
        ventricles=cut(volume.ventricles),
    )


def _image_of(mask: Path, extension: str, root: Path) -> tuple[Path | None, str]:
    """The image a mask belongs to and the subject's name, or None."""
    stem = mask.name[: -len(extension)]
    if stem == "mask":
        for name in IMAGE_NAMES:
            image = mask.with_name(name + extension)
            if image.exists():
                place = mask.parent.relative_to(root).as_posix()
                return image, mask.parent.resolve().name if place == "." else place
        return None, ""
    for ending in MASK_ENDINGS:
        if stem.endswith(ending):
            image = mask.with_name(stem[: -len(ending)] + extension)
            if image.exists():
                return image, (mask.parent / stem[: -len(ending)]).relative_to(root).as_posix()
    return None, ""


def _matches(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch(name, p) or fnmatch(name.rsplit("/", 1)[-1], p) for p in patterns)


def _resampled(
    data: NDArray[np.float32],
    mask: NDArray[np.bool_],
    labels: NDArray[np.uint8] | None,
    affine: NDArray[np.float64],
    spacing: NDArray[np.float64],
    spacing_mm: float,
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.uint8] | None, NDArray[np.float64]]:
    """Resample to isotropic voxels with the same axes.

    The image is interpolated by cubic splines, after smoothing along axes whose new voxels are larger.
    """
    step = spacing_mm / spacing  # old voxels per new voxel
    shape = np.maximum(np.floor((np.array(data.shape) - 1) / step).astype(int) + 1, 1)
    start = ((np.array(data.shape) - 1) - (shape - 1) * step) / 2
    sigma = 0.42 * np.sqrt(np.maximum(step**2 - 1, 0))  # a FWHM of one voxel, old and new, subtracted in quadrature
    smooth = gaussian_filter(data, sigma) if sigma.any() else data
    new = affine_transform(smooth, step, start, tuple(shape), order=3, mode="nearest")
    inside = affine_transform(mask.astype(np.float32), step, start, tuple(shape), order=1) > 0.5
    if labels is not None:
        labels = affine_transform(labels, step, start, tuple(shape), order=0)
    result = affine.copy()
    result[:3, :3] = affine[:3, :3] * step
    result[:3, 3] = affine[:3, :3] @ start + affine[:3, 3]
    logger.debug("resampled from %s to %.2f mm", np.round(spacing, 3), spacing_mm)
    return new.astype(np.float32), inside, labels, result
