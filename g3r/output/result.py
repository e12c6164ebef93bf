"""The result of a reconstruction, and the folder that it is written to."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.header_text import HeaderText
from g3r.acquisition.images import Space, save_volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.stacks import Stack
from g3r.errors import InputError, cannot_be_written
from g3r.geometry import VolumeGrid
from g3r.output.files import MASK_PICTURE, OUTPUT_NAMES, REUSE_NAME, slice_table
from g3r.output.record import RunRecord
from g3r.output.reuse_record import ReuseRecord, StackGrid
from g3r.run.output_folder import OutputFolder, check_output_folder

if TYPE_CHECKING:  # torch takes seconds to import, and a refusal should not wait for it
    from g3r.gaussians import GaussianCloud

CAPTIONS = {
    "density": "1: covered by one gapless stack",
    "prior share": "0: measured, 1: by the prior alone",
    "uncertainty": "expected error, in the volume's units",
}
"""Rows of sections.png that are maps, and how to read their values."""

RANGES = {"prior share": (0.0, 1.0)}

PICTURE_BYTES = 3_000_000
"""Upper limit of the picture, the tables and the record together."""


@dataclass(frozen=True, kw_only=True)
class ReconstructionResult:
    """One reconstructed subject; intensities are those of the stacks.

    Attributes:
        volume, mask: [I, J, K] on `grid`.
        unseen: [I, J, K] on `grid`, the part of the brain that no slice saw; inside the mask if it is shown at all.
        support: [I, J, K] on `grid`, where Gaussians were fitted.
        edge: [I, J, K] on `grid`, how much of the volume is shown (`Mixture`).
        prior, coarse, density: [I, J, K] on `prior_grid`; prior is V_sharp where no network was used.
        correction: D [I, J, K] on `prior_grid`, in normalised intensities (`Mixture`); None without one.
        cloud: the Gaussians, in normalised intensities (times `intensity_scale` gives the stacks').
        slices: slices in their final poses.
        gain, weight, ncc: [K] intensity factor, weight and correlation with the volume of each slice.
        uncertainty: [I, J, K] on `grid`, expected absolute error of the volume; zero outside the mask. None,
            and not written, if the run was interrupted (`record.partial`).
        prior_share: [I, J, K] on `grid`, 0 (measured) to 1 (the prior alone); None, and not written, where no
            prior was used.
        record: settings, versions, seconds, memory, warnings: run.json.
        stacks: its input stacks; their masks are written, too, unless they are the user's files.
        header_text: text for the headers of the files; None for no text.
    """

    volume: NDArray[np.float32]
    mask: NDArray[np.bool_]
    unseen: NDArray[np.bool_]
    support: NDArray[np.bool_]
    edge: NDArray[np.float16]
    grid: VolumeGrid
    prior: NDArray[np.float32]
    coarse: NDArray[np.float32]
    density: NDArray[np.float32]
    prior_grid: VolumeGrid
    correction: NDArray[np.float16] | None = None
    cloud: GaussianCloud
    intensity_scale: float
    slices: Slices
    gain: NDArray[np.float64]
    weight: NDArray[np.float64]
    ncc: NDArray[np.float64]
    uncertainty: NDArray[np.float32] | None
    prior_share: NDArray[np.float32] | None
    record: RunRecord
    stacks: tuple[Stack, ...] = ()
    header_text: HeaderText | None = None

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.grid.shape))
        return (
            f"ReconstructionResult({shape} voxels of {self.grid.spacing_mm[0]:g} mm, {len(self.slices)} slices, "
            f"{len(self.cloud)} Gaussians{', partial' if self.record.partial else ''})"
        )

    def save(
        self,
        folder: str | os.PathLike[str],
        *,
        replace: bool = False,
        run: OutputFolder | None = None,
        also: Callable[[Path], None] | None = None,
    ) -> None:
        """Write every output into a folder; it appears whole or not at all.

        Args:
            folder: folder to write.
            replace: whether an earlier result in it may be replaced; other files there are kept.
            run: holds this folder already; None takes it for this call alone.
            also: writes more files of `OUTPUT_NAMES`; called with the folder in which the others are.

        Raises:
            InputError: the folder holds files already (without `replace`), or cannot be written.
        """
        folder = Path(folder)
        if run is None:
            check_output_folder(folder, OUTPUT_NAMES, replace=replace)
            with OutputFolder(folder, OUTPUT_NAMES) as run:
                self.save(folder, replace=replace, run=run, also=also)
            return
        check_output_folder(folder, OUTPUT_NAMES, replace=replace)
        try:
            run.make_room(self._max_bytes() + PICTURE_BYTES)
            with run.result() as staged:
                self._write(staged)
                if also is not None:
                    also(staged)
        except OSError as error:
            raise cannot_be_written(folder, error, self._max_bytes()) from None

    def _max_bytes(self) -> int:
        """Size of all files together when uncompressed, without picture and tables."""
        arrays = [getattr(self, one.name) for one in fields(self)]
        arrays += [np.asarray(tensor) for tensor in self.cloud.parameters]
        return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))

    def _write(self, folder: Path) -> None:
        maps = {name: self.grid for name in ("volume", "mask", "unseen", "uncertainty", "prior_share")}
        maps |= {name: self.prior_grid for name in ("prior", "coarse", "density")}
        space: Space = self.record.registration.space if self.record.registration else "scanner"
        with ThreadPoolExecutor() as pool:  # compression runs while the sections are drawn
            saved = [
                pool.submit(save_volume, folder / f"{name}.nii.gz", data, grid.affine, self.header_text, space)
                for name, grid in maps.items()
                if (data := getattr(self, name)) is not None
            ]
            saved += [
                pool.submit(
                    save_volume, folder / f"brain-mask-{n}.nii.gz", stack.mask_as_in_file, stack.affine_as_in_file
                )
                for n, stack in self._found_masks()
            ]
            self._write_others(folder)
        for one in saved:
            one.result()

    def _write_others(self, folder: Path) -> None:
        from g3r.output.mask_picture import save_mask_picture
        from g3r.output.sections import save_sections

        self.cloud.save(folder / "gaussians.npz")
        table = slice_table(self.slices, self.gain, self.weight, self.ncc)
        self.reuse_record().save(folder / REUSE_NAME)
        (folder / "slices.tsv").write_text(table, encoding="utf-8")
        (folder / "run.json").write_text(self.record.to_json(), encoding="utf-8")
        rows, ranges = {"volume": self.volume}, dict(RANGES)
        if self.uncertainty is not None:
            rows["uncertainty"] = self.uncertainty
            # the rim is far more uncertain than the rest; let it saturate, so that the rest is visible
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
            marked=self.unseen,
            title=self._title(),
        )

        if found := self._found_masks():
            save_mask_picture(folder / MASK_PICTURE, [stack for _, stack in found])

    def reuse_record(self) -> ReuseRecord:
        """The record of what other commands need of this result beside its other files."""
        return ReuseRecord(
            grid=self.grid,
            support=self.support,
            edge=self.edge,
            prior_grid=self.prior_grid,
            correction=self.correction,
            intensity_scale=self.intensity_scale,
            stacks=tuple(StackGrid.of(stack) for stack in self.stacks),
            slices=replace(self.slices, value=np.zeros_like(self.slices.value), view=None),
            gain=self.gain,
            weight=self.weight,
        )

    def _found_masks(self) -> list[tuple[int, Stack]]:
        """Stacks whose masks are not the user's files, with their numbers."""
        return [(n, stack) for n, stack in enumerate(self.stacks) if stack.mask_source != "file"]

    def _title(self) -> str:
        """Warnings to print on the picture."""
        lines = []
        if self.record.stopped_at:
            lines.append(f"PARTIAL: {self.record.stopped_at}")
        if self.record.registration and self.record.registration.reliable is False:
            lines.append("REGISTRATION UNRELIABLE: do not rely on this volume (see run.json)")
        unseen = self.record.unseen.line() if self.record.unseen else None
        if unseen:
            lines.append(f"outlined: {unseen}")
        return "; ".join(lines)


def is_partial(folder: str | os.PathLike[str]) -> bool:
    """Whether a folder holds the result of an interrupted run."""
    try:
        return RunRecord.read(Path(folder) / "run.json").partial
    except InputError:
        return False
