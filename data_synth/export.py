"""Export of simulated stacks to a folder of NIfTI files with their true poses, written atomically."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from data_synth.atlas import TruthVolume
from data_synth.simulator import SimulatedStack
from g3r.acquisition.images import save_volume
from g3r.errors import InputError, cannot_be_written
from g3r.run.output_folder import FOUND_ON_DISKS, OutputFolder

POSE_COLUMNS = ("stack", "slice", "rx", "ry", "rz", "tx", "ty", "tz", "gain", "void")

OF_SUBJECT = {"truth.nii.gz", "truth-mask.nii.gz", "poses.tsv", "poses.json", "simulation.json"}
OF_STACK = re.compile(r"(stack|mask)-\d+\.nii\.gz")
"""Names of the files of a simulated subject, and those of its stacks."""


def save_simulation(
    folder: Path,
    truth: TruthVolume,
    stacks: Sequence[SimulatedStack],
    record: Mapping[str, object],
    *,
    replace: bool = False,
) -> None:
    """Write a simulated subject.

    - `stack-N.nii.gz` (int16) and `mask-N.nii.gz`; `truth.nii.gz` and `truth-mask.nii.gz`.
    - `poses.tsv`: a row per slice (`POSE_COLUMNS`). A point that the file's header puts at x is truly at R x + t;
      `void` is 1 where the slice lost its signal.
    - `poses.json`: a list of `stack`, `slice`, `rotation` [3, 3], `center` [3]. The point at (x, y) mm from the
      middle of the pixel grid is truly at rotation (x, y, 0) + center.
    - `simulation.json`: the record.

    Args:
        folder: output folder.
        truth: the volume that was sliced.
        stacks: simulated from it.
        record: settings, written with the data.
        replace: whether an earlier simulation may be replaced; other files of the folder stay.

    Raises:
        InputError: the folder exists and is not empty (without `replace`), or cannot be written.
    """
    check_output(folder, replace=replace)
    with OutputFolder(folder, _names(folder, len(stacks))) as run:
        check_output(folder, replace=replace)
        try:
            with run.result() as staging:
                _write(staging, truth, stacks, record)
        except OSError as error:
            raise cannot_be_written(folder, error) from None


def check_output(folder: Path, *, replace: bool) -> None:
    """Refuse an output that is a file, or a non-empty folder that may not be replaced.

    A folder to be replaced must hold an earlier simulation (a `poses.tsv`). What else it holds stays.

    Raises:
        InputError: see above.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise InputError(f"{folder}: is a file; expected a folder, choose another --output")
    content = {entry.name for entry in folder.iterdir()} - FOUND_ON_DISKS
    if content and not replace:
        raise InputError(f"{folder}: is not empty; pass --force to replace it, or choose another --output")
    if content and "poses.tsv" not in content:
        raise InputError(f"{folder}: holds something else than a simulation; choose another --output")


def _names(folder: Path, n_stacks: int) -> set[str]:
    """Names of files of a simulation: of the one to come, and of the one in the folder, if any."""
    earlier = {path.name for path in folder.iterdir() if OF_STACK.fullmatch(path.name)} if folder.is_dir() else set()
    return earlier | OF_SUBJECT | {f"{kind}-{n}.nii.gz" for kind in ("stack", "mask") for n in range(n_stacks)}


def _write(folder: Path, truth: TruthVolume, stacks: Sequence[SimulatedStack], record: Mapping[str, object]) -> None:
    save_volume(folder / "truth.nii.gz", truth.data, truth.affine)
    save_volume(folder / "truth-mask.nii.gz", truth.mask, truth.affine)
    centers = []
    with (folder / "poses.tsv").open("w", newline="") as file:
        table = csv.writer(file, delimiter="\t", lineterminator="\n")
        table.writerow(list(POSE_COLUMNS))
        for number, one in enumerate(stacks):
            stack = one.stack
            counts = np.clip(np.rint(stack.image), np.iinfo(np.int16).min, np.iinfo(np.int16).max)
            save_volume(folder / f"stack-{number}.nii.gz", counts.astype(np.int16), stack.affine)
            save_volume(folder / f"mask-{number}.nii.gz", stack.mask, stack.affine)
            frame = stack.grid.axes
            n_i, n_j, n_k = stack.image.shape
            rotvec, pose = one.true_pose.rotvec_rad(), one.true_pose
            for k in range(n_k):
                motion = [f"{v:.9g}" for v in (*rotvec[k], *pose.translation_mm[k])]
                table.writerow([number, k, *motion, f"{one.gain[k]:.6g}", int(one.dropout[k])])
                header_center = stack.grid.world([(n_i - 1) / 2, (n_j - 1) / 2, k])
                center = pose.rotation[k] @ header_center + pose.translation_mm[k]
                rotation = pose.rotation[k] @ frame
                centers.append({"stack": number, "slice": k, "rotation": rotation.tolist(), "center": center.tolist()})
    (folder / "poses.json").write_text(json.dumps(centers) + "\n")
    (folder / "simulation.json").write_text(json.dumps(record, indent=2) + "\n")
