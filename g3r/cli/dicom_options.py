"""The DICOM options of `g3r-infer`, and their implementation."""

from __future__ import annotations

import argparse
import logging
import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from g3r.cli.mask_options import AUTO
from g3r.errors import InputError

if TYPE_CHECKING:
    from g3r.dicom.choice import Judged
    from g3r.dicom.study import SourceStudy
    from g3r.output.result import ReconstructionResult

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class DicomInput:
    """DICOM input of a run: the examination, and remarks on its series.

    Attributes:
        study: examination that the volume is written into; None if it is not written as DICOM.
        warnings: warnings about the series, without patient data.
        notes: remarks for the record.
    """

    study: SourceStudy | None = None
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def add_input_options(parser: argparse._ActionsContainer) -> None:
    """Options for the stacks: NIfTI files, a folder of DICOM, or a folder of slices."""
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--stacks", nargs="+", metavar="NIFTI", help="one file per stack")
    source.add_argument(
        "--dicom",
        metavar="DIR",
        help="in place of --stacks: folder of one examination, whose 2D T2-weighted series are listed, chosen and "
        "converted (needs the dicom extra); --dry-run shows the list",
    )
    source.add_argument(
        "--slices",
        metavar="DIR",
        help="in place of --stacks: folder of slices whose headers hold their poses (N.nii.gz, mask_N.nii.gz), as "
        "NeSVoR and g3r-export-poses --format nesvor write them; poses are not searched",
    )
    parser.add_argument(
        "--series", nargs="+", metavar="N", help="with --dicom: numbers of the series to take, in place of the choice"
    )


def add_dicom_output_options(parser: argparse._ActionsContainer) -> None:
    """Options for the volume as DICOM."""
    parser.add_argument(
        "--dicom-out",
        metavar="DIR",
        help="also write the volume as an MR series of the examination, marked derived and not for diagnosis: the one "
        "output that names the patient",
    )
    parser.add_argument(
        "--dicom-reference",
        metavar="DIR",
        help="with --stacks and --dicom-out: DICOM images of the examination that the stacks are of",
    )


def check_dicom_options(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """End the program with 2 if DICOM options cannot be combined."""
    if options.series and not options.dicom:
        parser.error("--series is for --dicom, which is not given")
    if options.dicom_reference and (options.dicom or not options.dicom_out):
        parser.error("--dicom-reference is for --stacks with --dicom-out; --dicom knows its examination")
    if options.dicom_out and not (options.dicom or options.dicom_reference):
        parser.error("--dicom-out needs the examination: --dicom, or --dicom-reference with --stacks")
    if not options.dicom:
        return
    if options.keep_header_text:
        parser.error("--keep-header-text excludes --dicom: nothing of its headers is kept")
    several = options.thickness is not None and len(options.thickness) > 1
    if not options.series and (several or options.masks not in (None, [AUTO])):
        name = "--thickness" if several else "--masks"
        parser.error(f"{name} for each series needs --series, in the same order; --dry-run lists the series")
    if options.series and len(set(options.series)) < len(options.series):
        parser.error("--series names a series twice")
    options.stacks = [f"series-{label}" for label in options.series or []]  # until they are converted


@contextmanager
def stacks_on_disk(options: argparse.Namespace, *, replaces: bool) -> Iterator[DicomInput]:
    """Set `options.stacks` to paths of NIfTI files; files converted from DICOM are removed when the block ends.

    Args:
        options: options of g3r-infer.
        replaces: whether earlier results in the output may be replaced.

    Raises:
        InputError: a folder of DICOM cannot be used, or a stack is DICOM instead of NIfTI.
        ModuleNotFoundError: the dicom extra is not installed.
    """
    if options.dicom_out:
        _check_dicom_out(options)
    if not options.dicom:
        _refuse_dicom(options)
        yield DicomInput(study=_reference(options))
        return
    from g3r.dicom.convert import convert, converter_version
    from g3r.dicom.private_folder import private_folder
    from g3r.dicom.study import study_of
    from g3r.output.files import OUTPUT_NAMES
    from g3r.run.output_folder import check_output_folder

    check_output_folder(Path(options.output), OUTPUT_NAMES, replace=replaces)  # before anything is converted
    version = converter_version()
    taken, warnings = _chosen(options)
    study = None
    if options.dicom_out:
        study = study_of([image for one in taken for image in one.series.images], options.dicom)
    with private_folder() as folder:
        options.stacks = [str(convert(one.series, folder)) for one in taken]
        yield DicomInput(study=study, warnings=warnings, notes=[f"stacks made of DICOM by dcm2niix {version}"])


def _chosen(options: argparse.Namespace) -> tuple[list[Judged], list[str]]:
    """The chosen series, in the requested order, and warnings about the others; prints the table of series.

    Raises:
        InputError: no series can be taken, or they are not of one examination.
    """
    from g3r.dicom.choice import check_one_examination, judged
    from g3r.dicom.headers import read_images
    from g3r.dicom.series import grouped
    from g3r.dicom.table import table_of

    found = read_images(options.dicom)
    verdicts = judged(grouped(found.images), options.series)
    taken = [one for one in verdicts if one.is_taken]
    print(table_of(verdicts, descriptions=sys.stdout.isatty()), flush=True)
    if not taken:
        raise InputError(
            f"{options.dicom}: no series is a whole stack of T2-weighted slices (see the table); choose with --series"
        )
    check_one_examination([one.series for one in taken], options.dicom)
    if options.series:
        taken.sort(key=lambda one: options.series.index(one.series.label))
    warnings = [f"{one.series.name}: left out, {one.reason}" for one in verdicts if one.is_broken]
    if found.n_damaged:
        warnings.append(f"--dicom: {found.n_damaged} damaged DICOM files are left out; copy the folder again")
    if found.n_unreadable:
        warnings.append(
            f"--dicom: {found.n_unreadable} files and folders cannot be read and are left out; check their permissions"
        )
    if len({image.frame_uid for one in taken for image in one.series.images}) > 1:
        warnings.append("--dicom: the series have several frames of reference; their places may not agree")
    return taken, warnings


def _check_dicom_out(options: argparse.Namespace) -> None:
    """Refuse a folder that the series cannot be written to.

    Raises:
        InputError: as `check_new_folder`; or it is the output itself, or lies in the folder that is read.
    """
    from g3r.dicom.volume_series import check_new_folder

    check_new_folder(options.dicom_out)
    target = Path(os.path.realpath(options.dicom_out))
    source = Path(os.path.realpath(options.dicom or options.dicom_reference))
    if target == Path(os.path.realpath(options.output)):
        raise InputError(f"{options.dicom_out}: is --output, too; choose another --dicom-out")
    if target.is_relative_to(source):
        raise InputError(f"{options.dicom_out}: lies in the folder that is read; choose another --dicom-out")


def _refuse_dicom(options: argparse.Namespace) -> None:
    """Raise `InputError` for DICOM among the stacks, with the command line that works."""
    from g3r.dicom.files import holds_dicom, is_dicom

    for path in options.stacks:
        is_folder = os.path.isdir(path)
        if holds_dicom(path) if is_folder else is_dicom(path):
            folder = path if is_folder else os.path.dirname(path) or "."
            what = "a folder of DICOM images" if is_folder else "a DICOM image"
            line = f"g3r-infer --dicom {shlex.quote(folder)} --output {shlex.quote(options.output)}"
            raise InputError(f"{path}: is {what}; expected NIfTI, or pass the folder of the examination: {line}")


def _reference(options: argparse.Namespace) -> SourceStudy | None:
    if not options.dicom_reference:
        return None
    from g3r.dicom.study import read_study

    return read_study(options.dicom_reference)


def write_dicom(options: argparse.Namespace, result: ReconstructionResult, dicom: DicomInput) -> None:
    """Write the volume as a series of its examination, if asked for and if the result is not partial.

    Args:
        options: options of g3r-infer.
        result: result of the run.
        dicom: from `stacks_on_disk`.

    Raises:
        InputError: the folder cannot be written.
    """
    if dicom.study is None:
        return
    if result.record.partial:
        logger.warning("--dicom-out: not written, because the run was interrupted")
        return
    from g3r.dicom.volume_series import write_volume_series
    from g3r.report.verdict import verdict_of

    registration = result.record.registration
    write_volume_series(
        options.dicom_out,
        result.volume,
        result.grid.affine,
        dicom.study,
        in_scanner_space=registration is not None and registration.space == "scanner",
        remark=f"verdict: {verdict_of(result.record).line()}",
    )
    print(f"DICOM:   {options.dicom_out} (names the patient)")
