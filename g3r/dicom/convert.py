"""Series become NIfTI files with sidecars, by dcm2niix, one series at a time and under names that say nothing."""

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
"""Sidecars, without names and dates; no compression, so that the same images give the same bytes; no defaults of the
user's; no comment, in place of which dcm2niix would take the image's own."""

KEPT_KEYS = (
    "SliceThickness",
    "PhaseResolution",
    "PhaseEncodingDirection",
    "PhaseEncodingAxis",
    "InPlanePhaseEncodingDirectionDICOM",
)
"""What is left of a sidecar. It would name institution, device and times in spite of `-ba y`; and the distance of
slices follows from their places, so that what the header says of it does not matter."""

TIMEOUT_S = 600.0
"""A series takes a tenth of a second; a network drive may hang."""


def converter() -> str:
    """The path of dcm2niix: of its Python package, or else of the system.

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
        series: that can be a stack.
        folder: to write into, private.

    Raises:
        InputError: dcm2niix fails, or makes another stack of the series than its headers describe.
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
    # what dcm2niix printed is not passed on: it quotes headers
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
    """A link where the system allows it, or else a copy."""
    try:
        os.symlink(source, target)
    except OSError:
        shutil.copyfile(source, target)


def _check_geometry(path: Path, series: Series) -> None:
    """Raise `InputError` where slices were lost or are not as far apart as their headers say."""
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
    """Keep what decides the slice profile; a thickness of zero is none.

    Raises:
        InputError: it is not JSON.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8", errors="replace"), strict=False)
    except ValueError:
        raise InputError(
            f"{path.stem}: what dcm2niix says of it is not JSON; leave it out (--series), or convert it by hand, mend "
            "the file, and pass --stacks"
        ) from None
    path.write_text(json.dumps({key: found[key] for key in KEPT_KEYS if found.get(key)}), encoding="utf-8")
