"""What a reconstruction gives, and the folder that it is written to."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.header_text import HeaderText
from g3r.acquisition.images import save_volume
from g3r.acquisition.planes import Slices
from g3r.errors import InputError, cannot_be_written
from g3r.geometry import VolumeGrid
from g3r.run.output_folder import OutputFolder

if TYPE_CHECKING:  # torch takes seconds to import, and a refusal should not wait for it
    from g3r.gaussians import GaussianCloud

SLICE_COLUMNS = ("stack", "slice", "rx", "ry", "rz", "tx", "ty", "tz", "gain", "weight", "ncc", "reason")

FULL_WEIGHT = 0.99
"""Slices trusted less than this get a reason in slices.tsv."""

LOST_SIGNAL_GAIN, SMALL_SHARE, POOR_NCC = 0.6, 0.3, 0.8
"""A down-weighted slice with a gain below the first has lost signal; one with less than the second of its
stack's median of pixels is small; one that correlates less than the third with the volume does not fit."""

OUTPUT_NAMES = (
    "volume.nii.gz",
    "mask.nii.gz",
    "prior.nii.gz",
    "coarse.nii.gz",
    "density.nii.gz",
    "uncertainty.nii.gz",
    "prior_share.nii.gz",
    "gaussians.npz",
    "slices.tsv",
    "run.json",
    "sections.png",
)

CAPTIONS = {
    "density": "1: covered by one gapless stack",
    "prior share": "0: measured, 1: by the prior alone",
    "uncertainty": "expected error, in the volume's units",
}
"""Rows of sections.png that are maps, and how to read them."""

RANGES = {"prior share": (0.0, 1.0)}

PICTURE_BYTES = 3_000_000
"""More than the picture, the tables and the record ever took."""


@dataclass(frozen=True)
class ReconstructionResult:
    """One reconstructed subject; intensities are those of the stacks.

    Args:
        volume, mask: [I, J, K] on `grid`.
        prior, coarse, density: [I, J, K] on `prior_grid`; prior is V_sharp where no network was used.
        cloud: the Gaussians, in normalised intensities (times `intensity_scale` gives the stacks').
        slices: in their last poses.
        gain, weight, ncc: [K] intensity factor, trust and correlation with the volume of each slice.
        uncertainty: [I, J, K] on `grid`, expected absolute error of the volume; zero outside the mask. None,
            and not written, where the run was interrupted (`record["partial"]`).
        prior_share: [I, J, K] on `grid`, 0 (measured) to 1 (the prior alone); None, and not written, where no
            prior was used.
        record: settings, versions, seconds, memory, warnings: run.json.
        header_text: what the written headers say in words; nothing when None.
    """

    volume: NDArray[np.float32]
    mask: NDArray[np.bool_]
    grid: VolumeGrid
    prior: NDArray[np.float32]
    coarse: NDArray[np.float32]
    density: NDArray[np.float32]
    prior_grid: VolumeGrid
    cloud: GaussianCloud
    intensity_scale: float
    slices: Slices
    gain: NDArray[np.float64]
    weight: NDArray[np.float64]
    ncc: NDArray[np.float64]
    uncertainty: NDArray[np.float32] | None
    prior_share: NDArray[np.float32] | None = None
    record: dict[str, Any] = field(default_factory=dict)
    header_text: HeaderText | None = None

    def save(self, folder: str | os.PathLike[str], *, replace: bool = False, run: OutputFolder | None = None) -> None:
        """Write every output into a folder; it appears whole or not at all.

        Args:
            folder: to write.
            replace: whether an earlier result in it may be replaced; other files there are kept.
            run: that holds this folder already; one for this call alone when None.

        Raises:
            InputError: the folder holds files already (without `replace`), or cannot be written.
        """
        folder = Path(folder)
        if run is None:
            check_output_folder(folder, replace=replace)
            with OutputFolder(folder, OUTPUT_NAMES) as run:
                self.save(folder, replace=replace, run=run)
            return
        check_output_folder(folder, replace=replace)
        try:
            run.make_room(self._max_bytes() + PICTURE_BYTES)
            with run.result() as beside:
                self._write(beside)
        except OSError as error:
            raise cannot_be_written(folder, error, self._max_bytes()) from None

    def _max_bytes(self) -> int:
        """What the files take together if nothing could be compressed, but for the picture and tables."""
        arrays = [getattr(self, one.name) for one in fields(self)]
        arrays += [tensor.numpy() for tensor in self.cloud.parameters]
        return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))

    def _write(self, folder: Path) -> None:
        maps = {name: self.grid for name in ("volume", "mask", "uncertainty", "prior_share")}
        maps |= {name: self.prior_grid for name in ("prior", "coarse", "density")}
        with ThreadPoolExecutor() as pool:  # compression runs beside the drawing of sections
            saved = [
                pool.submit(save_volume, folder / f"{name}.nii.gz", data, grid.affine, self.header_text)
                for name, grid in maps.items()
                if (data := getattr(self, name)) is not None
            ]
            self._write_others(folder)
        for one in saved:
            one.result()

    def _write_others(self, folder: Path) -> None:
        from g3r.output.sections import save_sections

        self.cloud.save(folder / "gaussians.npz")
        (folder / "slices.tsv").write_text(self.slice_table(), encoding="utf-8")
        (folder / "run.json").write_text(json.dumps(self.record, indent=2) + "\n", encoding="utf-8")
        rows, ranges = {"volume": self.volume}, dict(RANGES)
        if self.uncertainty is not None:
            rows["uncertainty"] = self.uncertainty
            # the rim is far more uncertain than the rest; it may saturate, so that the rest is seen
            bright = float(np.percentile(self.uncertainty[self.mask], 97)) if self.mask.any() else 1.0
            ranges["uncertainty"] = (0.0, bright or 1.0)
        if self.prior_share is not None:
            rows["prior share"] = self.prior_share * self.mask
        if self.grid is self.prior_grid:
            on_mask = {name: getattr(self, name) * self.mask for name in ("coarse", "density", "prior")}
            rows = {**on_mask, **rows}
        save_sections(
            folder / "sections.png",
            rows,
            self.grid.affine,
            self.mask,
            maps=CAPTIONS,
            captions=CAPTIONS,
            ranges=ranges,
            title=self._title(),
        )

    def _title(self) -> str:
        """Of the picture: what must be known before it is believed."""
        said = []
        if self.record.get("partial"):
            cut = self.record["interrupted"]
            said.append(f"PARTIAL: interrupted in {cut['stage']}, step {cut['step']} of {cut['n_steps']}")
        if self.record.get("registration", {}).get("trusted") is False:
            said.append("REGISTRATION DOUBTFUL: do not trust this volume (see run.json)")
        return "; ".join(said)

    def slice_table(self) -> str:
        """slices.tsv: a point at x by the file's header is taken to be at R x + t (rotation vector, mm)."""
        motion = self.slices.world_from_header()
        rotvec = motion.rotvec_rad()
        lines = ["\t".join(SLICE_COLUMNS)]
        for k in range(len(self.slices)):
            pose = [f"{x:.9g}" for x in (*rotvec[k], *motion.translation_mm[k])]
            trust = [f"{x:.4g}" for x in (self.gain[k], self.weight[k], self.ncc[k])]
            reason = self._reason(k) if self.weight[k] < FULL_WEIGHT else "-"
            number = [str(self.slices.stack_id[k]), str(self.slices.slice_index[k])]
            lines.append("\t".join([*number, *pose, *trust, reason]))
        return "\n".join(lines) + "\n"

    def _reason(self, k: int) -> str:
        """Why slice k is trusted little, as far as its figures tell."""
        n_pixels = np.bincount(self.slices.pixel_plane, minlength=len(self.slices))
        typical = np.median(n_pixels[self.slices.stack_id == self.slices.stack_id[k]])
        if self.gain[k] < LOST_SIGNAL_GAIN:
            return "signal loss"
        if n_pixels[k] < SMALL_SHARE * typical:
            return "does not fit, small slice"
        return "does not fit" if self.ncc[k] < POOR_NCC else "high residual"


def check_output_folder(folder: Path, *, replace: bool, inputs: Sequence[str | os.PathLike[str]] = ()) -> None:
    """Refuse an output that is a file, or a folder that holds files unless they may be replaced.

    Args:
        folder: that will be written.
        replace: whether it may hold an earlier result.
        inputs: files that are read; none of them may be in the way.

    Raises:
        InputError: see above, or a parent in which no folder can be made and renamed.
    """
    try:
        if folder.is_symlink() and not folder.exists():
            raise InputError(f"{folder}: is a link to nothing; remove it or choose another --output")
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file; expected a folder, choose another --output")
        if folder.exists() and any(folder.iterdir()) and not replace:
            raise InputError(f"{folder}: is not empty; pass --force to replace an earlier result, or choose another")
        target = Path(os.path.realpath(folder))
        parent = next(path for path in target.parents if path.exists())
        if not parent.is_dir():
            raise InputError(f"{folder}: {parent.name} is a file; expected a folder, choose another --output")
        usable = [parent, target] if target.exists() else [parent]
        if not all(os.access(path, os.W_OK | os.X_OK) for path in usable):
            raise InputError(f"{folder}: cannot be written; choose another --output")
        if target.exists() and target.stat().st_dev != parent.stat().st_dev:
            raise InputError(
                f"{folder}: is a file system of its own, and a result is put in place as a whole folder; "
                f"choose a folder in it, as {folder / 'result'}"
            )
        outputs = {(folder / name).resolve() for name in OUTPUT_NAMES}
    except (OSError, ValueError, RuntimeError) as error:  # a name too long, a loop of links
        found = getattr(error, "strerror", None) or error
        raise InputError(f"{folder}: cannot be written ({found}); choose another --output") from None
    for path in inputs:
        try:
            is_output = Path(path).resolve() in outputs
        except (OSError, ValueError, RuntimeError):  # who reads it says what is wrong
            continue
        if is_output:
            raise InputError(f"{path}: would be replaced by a result of its name; choose another --output")


def is_partial(folder: str | os.PathLike[str]) -> bool:
    """Whether a folder holds the result of an interrupted run."""
    try:
        record = json.loads((Path(folder) / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(record, dict) and record.get("partial") is True
