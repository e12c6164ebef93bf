"""Conversion of series to NIfTI files with sidecars, by dcm2niix, one at a time, under names free of patient data."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np

from g3r.acquisition.nifti import open_nifti
from g3r.dicom.series import UNEVEN_FROM, Series
from g3r.errors import InputError

OPTIONS = ("-b", "y", "-ba", "y", "-z", "n", "-g", "i", "-c", "")
"""Sidecars without names and dates; no compression, so that the same images give the same bytes; no defaults of the
user; an empty comment, because dcm2niix would otherwise copy the image's own."""

KEPT_KEYS = (
    "SliceThickness",
    "PhaseResolution",
    "PhaseEncodingDirection",
    "PhaseEncodingAxis",
    "InPlanePhaseEncodingDirectionDICOM",
)
"""Keys that are kept of a sidecar. The others include institution, device and times in spite of `-ba y`. The slice
spacing follows from the places of slices, so the header's own value is not needed."""

TIMEOUT_S = 600.0
"""Time limit of a conversion, which takes a tenth of a second; a network drive may hang."""


def converter() -> str:
    """The path of dcm2niix: from its Python package, or else from the system.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    try:
        import dcm2niix
    except ModuleNotFoundError:
        found = shutil.which("dcm2niix")
        if found is None:
            raise
        return found
    return str(dcm2niix.bin)


def converter_version() -> str:
    """The version that dcm2niix prints, such as v1.0.20260724; "unknown" where it prints none.

    Raises:
        InputError: dcm2niix cannot be started.
        ModuleNotFoundError: dcm2niix is not installed.
    """
    try:
        printed = _run([converter(), "--version"]).stdout.decode(errors="replace")
    except subprocess.TimeoutExpired:
        return "unknown"
    found = re.search(r"v\d[\d.]+", printed)
    return found[0] if found else "unknown"


def convert(series: Series, folder: Path) -> Path:
    """Write a series as `series-N.nii` with `series-N.json`; returns the path of the image.

    Args:
        series: a series that can be a stack.
        folder: private folder to write into.

    Raises:
        InputError: dcm2niix fails, or its stack differs from what the headers describe.
        ModuleNotFoundError: dcm2niix is not installed.
    """
    images, target = folder / f"{series.name}-images", folder / f"{series.name}.nii"
    images.mkdir()
    for n, image in enumerate(series.by_place):
        _link(image.path.resolve(), images / f"{n:05d}.dcm")
    words = [converter(), *OPTIONS, "-f", series.name, "-o", str(folder), str(images)]
    try:
        done = _run(words)
    except subprocess.TimeoutExpired:
        raise InputError(
            f"{series.name}: dcm2niix did not end within {TIMEOUT_S:g} s and was stopped; copy the folder to a local "
            "disk, or leave the series out (--series)"
        ) from None
    shutil.rmtree(images)
    # the output of dcm2niix is not passed on, because it quotes headers
    made = sorted(path.name for path in folder.glob(f"{series.name}*.nii") if _is_of(path.name, series.name))
    if done.returncode or made != [target.name]:
        found = f"exit code {done.returncode}" if done.returncode else f"{len(made)} images in place of one"
        raise InputError(
            f"{series.name}: dcm2niix did not make a stack of it ({found}); leave it out (--series), or convert it by "
            "hand to see why, and pass --stacks"
        )
    _check_geometry(target, series)
    _reduce_sidecar(target.with_suffix(".json"))
    return target


def _run(words: list[str]) -> subprocess.CompletedProcess[bytes]:
    """A command of dcm2niix, ended.

    Raises:
        InputError: it cannot be started.
        subprocess.TimeoutExpired: it does not end within `TIMEOUT_S`.
    """
    try:
        return subprocess.run(words, capture_output=True, timeout=TIMEOUT_S, check=False)
    except OSError as error:
        raise InputError(f"dcm2niix cannot be started ({error.strerror}); reinstall it: pip install dcm2niix") from None


def _is_of(name: str, series_name: str) -> bool:
    """Whether a file is of a series: series-3_Eq_1.nii is of series-3, series-31.nii is not."""
    return not name[len(series_name)].isalnum()


def _link(source: Path, target: Path) -> None:
    """Make a link if the system allows it, or else a copy."""
    try:
        os.symlink(source, target)
    except OSError:
        shutil.copyfile(source, target)


def _check_geometry(path: Path, series: Series) -> None:
    """Raise `InputError` if slices were lost, or if their spacing differs from the headers'."""
    image, _ = open_nifti(path)
    spacing_mm = series.spacing_mm
    assert spacing_mm is not None
    step_mm = float(np.linalg.norm(image.affine[:3, 2]))
    if image.shape[2:] != (series.n_images,) or not 1 / UNEVEN_FROM < step_mm / spacing_mm < UNEVEN_FROM:
        shape = " x ".join(map(str, image.shape))
        raise InputError(
            f"{series.name}: dcm2niix made {shape} voxels of it, {step_mm:.4g} mm apart; expected {series.n_images} "
            f"slices {spacing_mm:.4g} mm apart, leave it out (--series)"
        )


def _reduce_sidecar(path: Path) -> None:
    """Reduce a sidecar to the keys that determine the slice profile; empty and zero values are dropped.

    Raises:
        InputError: the sidecar is not JSON.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8", errors="replace"), strict=False)
    except ValueError:
        raise InputError(
            f"{path.stem}: what dcm2niix says of it is not JSON; leave it out (--series), or convert it by hand, mend "
            "the file, and pass --stacks"
        ) from None
    path.write_text(json.dumps({key: found[key] for key in KEPT_KEYS if found.get(key)}), encoding="utf-8")
