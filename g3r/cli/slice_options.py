"""The options of `g3r-infer` for folders of slices with poses, and their implementation."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from g3r.output.record import RunRecord
    from g3r.reuse.slice_input import SliceFolder
    from g3r.run.provenance import FileHash

WITHOUT_STACKS = {
    "masks": "masks are mask_N.nii.gz in the folder",
    "mask_command": "masks are mask_N.nii.gz in the folder",
    "mask_timeout": "masks are mask_N.nii.gz in the folder",
    "mask_ckpt": "masks are mask_N.nii.gz in the folder",
    "whole_image": "without mask_N.nii.gz pixels above zero are taken",
    "series": "that is for --dicom",
    "keep_header_text": "headers of slices hold poses alone",
    "dicom_out": "whether the poses lead to the scanner's frame is not known",
    "dicom_reference": "whether the poses lead to the scanner's frame is not known",
}
"""Options that make no sense with --slices, and why."""


def add_slice_options(parser: argparse._ActionsContainer) -> None:
    """Add the options for given poses."""
    parser.add_argument(
        "--keep-poses",
        action="store_true",
        help="with --slices: slices are not moved against each other (default: the fit refines their poses)",
    )


def check_slice_options(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """End the program with 2 if options on slices cannot be combined."""
    if not options.slices:
        if options.keep_poses:
            parser.error("--keep-poses is for --slices, which is not given")
        return
    for name, reason in WITHOUT_STACKS.items():
        if getattr(options, name) not in (None, False):
            parser.error(f"--slices excludes --{name.replace('_', '-')}: {reason}")
    if options.keep_poses and options.config:
        parser.error("--config and --keep-poses exclude each other: the file decides that")
    options.stacks = []  # they are made from the slices


def load_slices(options: argparse.Namespace, earlier: RunRecord | None) -> SliceFolder:
    """The slice folder, with thickness and profile of the repeated run if that has the same number of stacks.

    Args:
        options: options of g3r-infer.
        earlier: the run of --config.

    Raises:
        InputError: the folder cannot be used.
    """
    from g3r.reuse.slice_input import load_slice_folder

    found = load_slice_folder(options.slices, options.thickness)
    if earlier is None or options.thickness or len(earlier.stacks) != len(found.stacks):
        return found
    profiles = [stack.profile() for stack in earlier.stacks]
    stacks = [
        replace(stack, thickness_mm=one.thickness_mm, in_plane_fwhm_pixels=one.in_plane_fwhm_pixels, origin=one.origin)
        for stack, one in zip(found.stacks, profiles, strict=True)
    ]
    return replace(found, stacks=stacks)


def slice_hashes(folder: SliceFolder) -> tuple[tuple[FileHash, ...], tuple[FileHash, ...]]:
    """Two hashes per stack: of its slices' files with their places, and of its masks.

    Raises:
        InputError: a file cannot be read.
    """
    from g3r.run.provenance import FileHash

    stacks, masks = [], []
    for group in folder.groups:
        images = [FileHash.of(one.path) for one in group.files]
        places = [f"{index}" for index in group.place]
        stacks.append(_together(group.name, [*places, *(one.sha256 for one in images)]))
        own = [FileHash.of(one.mask_path).sha256 if one.mask_path else "above zero" for one in group.files]
        masks.append(_together(f"masks of {group.name}", own))
    return tuple(stacks), tuple(masks)


def _together(name: str, parts: Sequence[str]) -> FileHash:
    import hashlib

    from g3r.run.provenance import FileHash

    return FileHash(name, hashlib.sha256(" ".join(parts).encode()).hexdigest())
