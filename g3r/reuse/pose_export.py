"""The poses of a finished run as a folder for other programs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

from g3r.acquisition.planes import Slices
from g3r.errors import InputError
from g3r.geometry import RigidPose
from g3r.reuse.finished_run import FinishedRun
from g3r.reuse.slice_folder import simulated_slices, write_slices
from g3r.reuse.transform_files import write_dof, write_itk

TransformFormat = Literal["itk", "mirtk"]

WRITERS: dict[TransformFormat, tuple[str, Callable[[Path, RigidPose], None]]] = {
    "itk": (".tfm", write_itk),
    "mirtk": (".dof", write_dof),
}
"""Ending and writer of each format."""


def write_transforms(folder: Path, run: FinishedRun, form: TransformFormat) -> int:
    """Write one motion per slice, and `standard_from_scanner` if the run is in standard space.

    Args:
        folder: existing folder.
        run: the run with the poses.
        form: format of the files.

    Returns:
        The number of slices.
    """
    suffix, write = WRITERS[form]
    slices = run.geometry.slices
    motion = slices.world_from_header()
    for k in range(len(slices)):
        name = f"stack-{slices.stack_id[k]}_slice-{slices.slice_index[k]:03d}{suffix}"
        write(folder / name, motion.take([k]))
    if run.standard_from_scanner is not None:
        write(folder / f"standard_from_scanner{suffix}", run.standard_from_scanner)
    return len(slices)


def write_slice_folders(folder: Path, run: FinishedRun, measured: Slices | None) -> int:
    """Write `slices/` (if their pixels are given), `simulated/` and `index.tsv`, with stack and slice of each number.

    Args:
        folder: existing folder.
        run: the run with poses and Gaussians.
        measured: the run's slices with the pixels of its stacks; None if these were not given.

    Returns:
        The number of slices.

    Raises:
        InputError: there are no Gaussians to simulate slices from.
    """
    slices = run.geometry.slices
    if not len(run.cloud):
        raise InputError(
            f"{run.folder}: holds no Gaussians: no fit was made, or it was interrupted; run with --preset fast or "
            "better, or finish it with --resume"
        )
    parts = {"simulated": replace(slices, value=simulated_slices(run))}
    if measured is not None:
        parts["slices"] = measured
    for name, one in parts.items():
        (folder / name).mkdir()
        write_slices(folder / name, one, run.space)
    rows = [f"{k}\t{slices.stack_id[k]}\t{slices.slice_index[k]}" for k in range(len(slices))]
    (folder / "index.tsv").write_text("\n".join(["number\tstack\tslice", *rows]) + "\n", encoding="utf-8")
    return len(slices)
