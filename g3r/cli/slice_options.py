"""The options of `g3r-infer` about folders of slices with poses, and what they mean."""

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
    """What may be done with given poses."""
    parser.add_argument(
        "--keep-poses",
        action="store_true",
        help="with --slices: slices are not moved against each other (default: the fit refines their poses)",
    )


def check_slice_options(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """End the program with 2 where options on slices cannot go together."""
    if not options.slices:
        if options.keep_poses:
            parser.error("--keep-poses is for --slices, which is not given")
        return
    for name, reason in WITHOUT_STACKS.items():
        if getattr(options, name) not in (None, False):
            parser.error(f"--slices excludes --{name.replace('_', '-')}: {reason}")
    if options.keep_poses and options.config:
        parser.error("--config and --keep-poses exclude each other: the file decides that")
    options.stacks = []  # they are made of the slices


def load_slices(options: argparse.Namespace, earlier: RunRecord | None) -> SliceFolder:
    """The folder, with thickness and profile of the run that is repeated where it is one of as many stacks.

    Args:
        options: of g3r-infer.
        earlier: the run that --config names.

    Raises:
        InputError: a folder that cannot be used.
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
    """One hash for each stack of the files of its slices and their places, and one of its masks.

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
