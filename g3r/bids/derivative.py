"""Conversion of a result folder to the files of one session in the derivative data set, whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nibabel as nib

from g3r.bids.dataset import Session
from g3r.bids.description import SOURCE, as_json, read_object
from g3r.bids.names import NIFTI_ENDINGS
from g3r.bids.thumbnail import thumbnail
from g3r.bids.transform import itk_text
from g3r.run.atomic_file import sync

RECORD = "run.json"

REC = "rec-g3r"

XFM = "from-scanner_to-standard_mode-image_xfm.txt"


@dataclass(frozen=True)
class Image:
    """An image of the derivative: end of its name, its content in words, and further keys of its sidecar."""

    end: str
    shows: str
    keys: tuple[tuple[str, object], ...] = ()


IMAGES = {
    "volume.nii.gz": Image("T2w", "volume, in the intensities of the stacks", (("Units", "arbitrary"),)),
    "mask.nii.gz": Image("desc-brain_mask", "brain", (("Type", "Brain"),)),
    "uncertainty.nii.gz": Image(
        "desc-uncertainty_T2w", "expected absolute error, in the volume's units", (("Units", "arbitrary"),)
    ),
    "prior_share.nii.gz": Image(
        "desc-priorshare_T2w", "share of the prior: 0 slices, 1 prior alone", (("Units", "1"),)
    ),
    "density.nii.gz": Image("desc-coverage_T2w", "coverage by slices: 1 is one stack without gaps", (("Units", "1"),)),
    "unseen.nii.gz": Image("desc-unseen_mask", "brain that no slice saw", (("Type", "ROI"),)),
}
"""Images of the derivative by their name in the result folder."""

SECTIONS, THUMBNAIL, REPORT = "desc-sections_T2w.png", "desc-thumbnail_T2w.png", "desc-report_T2w.html"

FIGURES = {"sections.png": SECTIONS, "masks.png": "desc-masks_T2w.png", "report.html": REPORT}

WORDS = {
    "standard": "in standard orientation (RAS, mid-sagittal plane at x = 0), not in scanner space",
    "scanner": "in scanner space",
}


def record_path(session: Session, out_dir: Path) -> Path:
    """Path of the record of a session; the file exists only once the session is complete."""
    return out_dir / session.folder / "anat" / f"{session.stem}_{REC}_run.json"


def figure_path(session: Session, out_dir: Path, end: str = SECTIONS) -> Path:
    """Path of a picture of a session.

    Args:
        session: session of the data set.
        out_dir: the derivative data set.
        end: end of the file's name; by default that of the picture of sections.
    """
    return out_dir / session.folder / "figures" / f"{session.stem}_{REC}_{end}"


def make_derivative(
    session: Session, result: Path, inputs: Sequence[Path], bids_dir: Path, out_dir: Path, staging: Path
) -> None:
    """Put the result of a session into the derivative data set.

    The anat folder is renamed as a whole, last. An earlier one is replaced, but files in it that other programs made
    are kept.

    Args:
        session: session of the result.
        result: folder that g3r-infer wrote.
        inputs: stacks and masks that it read.
        bids_dir: the input data set.
        out_dir: the derivative data set.
        staging: temporary folder, on the file system of `out_dir`.

    Raises:
        OSError: something cannot be written.
        InputError: the record of the result cannot be read.
    """
    anat, figures, target = staging / "anat", staging / "figures", out_dir / session.folder
    _put_back(staging, target)
    shutil.rmtree(staging, ignore_errors=True)
    for folder in (anat, figures, target):
        folder.mkdir(parents=True, exist_ok=True)
    begin = f"{session.stem}_{REC}"
    record = read_object(result / RECORD)
    sources = [_uri(path, bids_dir) for path in inputs]
    space = (record.get("registration") or {}).get("space", "scanner")
    for name, image in IMAGES.items():
        if (result / name).is_file():
            shutil.copyfile(result / name, anat / f"{begin}_{image.end}.nii.gz")
            keys = _sidecar(result / name, image, WORDS[space], f"bids::{_inside(session, f'{begin}_T2w.nii.gz')}")
            (anat / f"{begin}_{image.end}.json").write_text(as_json(keys | {"Sources": sources}), encoding="utf-8")
    _copy_found_masks(session, result, record, bids_dir, anat)
    shutil.copyfile(result / "slices.tsv", anat / f"{begin}_slices.tsv")
    _write_transforms(session, record, anat)
    for name, end in FIGURES.items():
        if (result / name).is_file():
            shutil.copyfile(result / name, figures / f"{begin}_{end}")
    (figures / f"{begin}_{THUMBNAIL}").write_bytes(thumbnail(result / "volume.nii.gz"))
    shutil.copyfile(result / RECORD, anat / f"{begin}_run.json")
    _keep_others(target / "anat", anat, begin)
    for path in (*anat.iterdir(), *figures.iterdir()):  # a full disk may be reported only now
        if path.is_file():
            sync(path)
    _exchange(figures, target / "figures", staging)
    _exchange(anat, target / "anat", staging)
    shutil.rmtree(staging, ignore_errors=True)


def _sidecar(path: Path, image: Image, where: str, volume: str) -> dict[str, Any]:
    """The sidecar of an image of the derivative, without its sources.

    Args:
        path: the image.
        image: its kind.
        where: the space of its grid, in words.
        volume: URI of the volume whose space it is in.
    """
    zooms = nib.Nifti1Image.from_filename(path).header.get_zooms()
    is_volume = image.end == "T2w"
    return {
        "Description": f"Fetal brain by g3r: {image.shows}; {where}. For research only, not for diagnosis.",
        "SkullStripped": True,
        "Resolution": " x ".join(f"{zoom:.3g}" for zoom in zooms) + " mm",
        "SpatialReference": "orig" if is_volume else volume,
        **dict(image.keys),
    }


def _write_transforms(session: Session, record: dict[str, Any], anat: Path) -> None:
    """Write transforms from the scanner, for all slices and for each stack; none if the result is in scanner space."""
    motions = {f"{session.stem}_{REC}": (record.get("registration") or {}).get("standard_from_scanner")}
    for one in record.get("stacks", []):
        motions[_scan(str(one.get("name")))] = one.get("standard_from_scanner")
    for begin, motion in motions.items():
        if motion is not None:
            (anat / f"{begin}_{XFM}").write_text(itk_text(motion), encoding="ascii")


def _copy_found_masks(session: Session, result: Path, record: dict[str, Any], bids_dir: Path, anat: Path) -> None:
    """Copy masks that were found; they are derivatives of their stacks, on the stacks' grids."""
    stacks = {path.name: path for path in session.stacks}
    for n, one in enumerate(record.get("stacks", [])):
        path, stack = result / f"brain-mask-{n}.nii.gz", stacks.get(one.get("name"))
        if stack is None or not path.is_file():
            continue
        begin = f"{_scan(stack.name)}_desc-brain_mask"
        shutil.copyfile(path, anat / f"{begin}.nii.gz")
        keys = {
            "Type": "Brain",
            "Description": f"found by: {one.get('mask_from')}",
            "SpatialReference": "orig",
            "Sources": [_uri(stack, bids_dir)],
        }
        (anat / f"{begin}.json").write_text(as_json(keys), encoding="utf-8")


def _keep_others(earlier: Path, new: Path, begin: str) -> None:
    """Copy files of other programs beside an earlier result, whose own files begin with `begin`."""
    ends = [f"{image.end}{ending}" for image in IMAGES.values() for ending in (".nii.gz", ".json")]
    own = {f"{begin}_{end}" for end in (*ends, "run.json", "slices.tsv")}
    of_stacks = ("_desc-brain_mask.nii.gz", "_desc-brain_mask.json", XFM)
    for path in earlier.iterdir() if earlier.is_dir() else []:
        if path.name not in own and not path.name.endswith(of_stacks) and not (new / path.name).exists():
            if path.is_dir():
                shutil.copytree(path, new / path.name)
            else:
                shutil.copy2(path, new / path.name)


def _exchange(new: Path, target: Path, staging: Path) -> None:
    """Rename a folder to its place; an earlier one is moved aside."""
    if target.exists():
        os.rename(target, staging / f"earlier-{target.name}")
    os.rename(new, target)


def _put_back(staging: Path, target: Path) -> None:
    """Undo an exchange that was killed between its two renames."""
    for name in ("figures", "anat"):
        earlier = staging / f"earlier-{name}"
        if earlier.exists() and not (target / name).exists():
            os.rename(earlier, target / name)


def _scan(name: str) -> str:
    """The entities of a stack's file name, without suffix and ending."""
    ending = next((one for one in NIFTI_ENDINGS if name.endswith(one)), "")
    return name.removesuffix(ending).removesuffix("_T2w")


def _uri(path: Path, bids_dir: Path) -> str:
    """The BIDS URI of an input."""
    return f"bids:{SOURCE}:{path.relative_to(bids_dir).as_posix()}"


def _inside(session: Session, name: str) -> str:
    return (session.folder / "anat" / name).as_posix()
