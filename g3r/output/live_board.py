"""Live view of a run in TensorBoard: losses, poses, gains and sections at the steps of its fits."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import singledispatchmethod
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Planes
from g3r.fitting.held_out_slices import HeldOutChoice
from g3r.fitting.initial_volumes import InitialVolumes, PriorVolume
from g3r.fitting.observer import FitMoment, SliceMoment
from g3r.fitting.pose_rounds import RefinedPoses
from g3r.gaussians import GaussianCloud, render
from g3r.geometry import VolumeGrid
from g3r.output.mixture import FinishedVolume
from g3r.registration import Registration
from g3r.run.reporter import Reporter

logger = logging.getLogger(__name__)

SLICES_EVERY = 5
"""Steps of a fit between two records of its slices."""

SECTION_EVERY = 10
"""Least number of steps between two sections of its volume."""

SECTION_SHARE = 0.005
"""Largest share of the fit's time that sections may take; after a slow section the next one waits longer."""

FLUSH_S = 0.5
"""Seconds between writes to the disk, which a killed run may lose."""

SECTION_MM = 1.0
"""Pixel size of these sections."""

NAMES = ("sagittal", "coronal", "axial")


class LiveBoard(Reporter):
    """Writes figures of a run while it runs, as a context manager; they are on the disk within `FLUSH_S`.

    It is a reporter of stages and the observer of both fits.

    Args:
        folder: folder of the event file.

    Raises:
        OSError: it cannot be written.
    """

    every = 1

    def __init__(self, folder: Path) -> None:
        from tensorboard.compat.proto.summary_pb2 import Summary
        from torch.utils.tensorboard import SummaryWriter

        self._summary, self._value = Summary, Summary.Value
        self.writer = SummaryWriter(str(folder))
        self.stage, self.n_stages = "", 0
        self.works = True
        self.begun_s = self.stage_begun_s = time.monotonic()
        self.planes: Planes | None = None
        self.top = 1.0
        self.sections_s = 0.0
        self.flushed_s = self.begun_s

    def __enter__(self) -> LiveBoard:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._as_long_as_it_works():
            self.writer.close()

    def begun(self, stage: str) -> None:
        """See `Reporter`."""
        self.stage, self.stage_begun_s, self.sections_s = str(stage), time.monotonic(), 0.0

    def ended(self, stage: str, found: object, *, resumed: bool = False) -> None:
        """See `Reporter`; writes the seconds of the stage, and its result."""
        self.stage = str(stage)
        now = time.monotonic()
        with self._as_long_as_it_works():
            if not resumed:
                seconds = {self.stage: now - self.stage_begun_s, "all": now - self.begun_s}
                self._scalars("seconds", seconds, self.n_stages)
            self.n_stages += 1
            self._write(found)
            self._flush()

    def __call__(self, moment: FitMoment) -> None:
        """A step of a fit."""
        with self._as_long_as_it_works():
            self._step(moment)

    @contextmanager
    def _as_long_as_it_works(self) -> Iterator[None]:
        """If the disk is full, the run goes on without TensorBoard."""
        try:
            yield
        except OSError as error:
            if self.works:
                logger.warning("--tensorboard: cannot be written (%s); the run goes on without it", error.strerror)
            self.works = False

    def _step(self, moment: FitMoment) -> None:
        if not self.works:
            return
        passed_s = time.monotonic() - self.stage_begun_s
        figures = {f"loss/{name}": value for name, value in moment.loss.items()}
        figures |= {"seconds": passed_s, "Gaussians": len(moment.parameters)}
        if moment.slices is not None and moment.step % SLICES_EVERY == 0:
            figures |= _of_slices(moment.slices, moment.parameters.origin_mm)
        self._scalars(self.stage, figures, moment.step)
        if moment.step % SECTION_EVERY == 0 and self.sections_s <= SECTION_SHARE * passed_s:
            self._sections_of(moment.cloud(), moment.step)
            self.sections_s += time.monotonic() - self.stage_begun_s - passed_s
        if time.monotonic() - self.flushed_s > FLUSH_S:
            self._flush()

    @singledispatchmethod
    def _write(self, found: object) -> None:
        """Write the result of a stage, if there is anything to show."""

    @_write.register
    def _(self, found: Registration) -> None:
        if found.held_out is not None:
            stacks = {f"stack {n}": value for n, value in enumerate(found.held_out)}
            self._scalars(f"{self.stage}/correlation with the others", stacks, 0)
        for step, entry in enumerate(found.history):
            self._scalars(f"{self.stage}/rounds", entry, step)

    @_write.register
    def _(self, found: InitialVolumes) -> None:
        self._volume(found.coarse, found.coarse > 0, "coarse")

    @_write.register
    def _(self, found: PriorVolume) -> None:
        self.planes = middle_planes(found.volumes.grid, found.mask)
        self.top = float(np.percentile(found.values[found.mask], 99.5)) if found.mask.any() else 1.0
        self._volume(found.values, found.mask, "prior")

    @_write.register
    def _(self, found: RefinedPoses) -> None:
        for n, value in enumerate(found.record.held_out):
            self._scalars(self.stage, {"held-out correlation": value}, n)
        self._write(found.prior)

    @_write.register
    def _(self, found: HeldOutChoice) -> None:
        for width, error in found.error.items():
            self._scalars(f"{self.stage}/error by width in percent", {"error": error}, round(100 * float(width)))

    @_write.register
    def _(self, found: FinishedVolume) -> None:
        self._volume(found.volume, found.mask, "volume")

    def _scalars(self, where: str, figures: Mapping[str, float], step: int) -> None:
        """Write all figures of a step as one event, several times faster than one event each."""
        values = [self._value(tag=f"{where}/{name}", simple_value=float(value)) for name, value in figures.items()]
        self.writer._get_file_writer().add_summary(self._summary(value=values), step)

    def _flush(self) -> None:
        self.writer.flush()
        self.flushed_s = time.monotonic()

    def _volume(self, volume: NDArray[np.float32], mask: NDArray[np.bool_], name: str) -> None:
        """Middle sections of a volume [I, J, K]."""
        middle = [int(n.mean()) if len(n) else 0 for n in mask.nonzero()]
        top = float(np.percentile(volume[mask], 99.5)) if mask.any() else 1.0
        for axis, view in enumerate(NAMES):
            self._image(f"{name}/{view}", np.take(volume, middle[axis], axis=axis), top, 0)

    def _sections_of(self, cloud: GaussianCloud, step: int) -> None:
        """The Gaussians on three planes through the middle of the brain."""
        if self.planes is None:
            return
        pixels = render(cloud, self.planes).numpy()
        for k, view in enumerate(NAMES):
            of_plane = pixels[self.planes.offset[k] : self.planes.offset[k + 1]]
            self._image(f"{self.stage}/{view}", of_plane.reshape(self.planes.shape[k]), self.top, step)

    def _image(self, name: str, section: NDArray[np.float32], top: float, step: int) -> None:
        shown = np.clip(section / (top or 1.0), 0, 1)
        self.writer.add_image(name, shown.T[::-1].copy(), step, dataformats="HW")


def middle_planes(grid: VolumeGrid, mask: NDArray[np.bool_]) -> Planes:
    """The sagittal, the coronal and the axial plane through the middle of a mask [I, J, K], without a PSF."""
    box = np.argwhere(mask) if mask.any() else np.array([[0, 0, 0], np.array(grid.shape) - 1])
    low_mm, high_mm = grid.world(box.min(0)), grid.world(box.max(0))
    center_mm, size_mm = (low_mm + high_mm) / 2, np.abs(high_mm - low_mm)
    directions = grid.affine[:3, :3] / grid.spacing_mm
    axes = [(1, 2, 0), (0, 2, 1), (0, 1, 2)]
    rotation = np.stack([directions[:, list(one)] for one in axes])
    rotation[:, :, 2] *= np.sign(np.linalg.det(rotation))[:, None]  # a left-handed grid shows the same plane
    along_mm = np.abs(np.linalg.solve(directions, high_mm - low_mm)) if size_mm.any() else np.ones(3)
    shape = np.array([[int(along_mm[n] / SECTION_MM) + 1 for n in one[:2]] for one in axes])
    return Planes(
        rotation=rotation,
        center_mm=np.repeat(center_mm[None], 3, 0),
        spacing_mm=np.full((3, 2), SECTION_MM),
        shape=shape,
        psf_var_mm2=np.zeros((3, 3)),
    )


def _of_slices(slices: SliceMoment, origin_mm: NDArray[np.float64]) -> dict[str, float]:
    """Motion of slices since the fit began, and their gains and weights."""
    moved_mm, turned_deg = slices.moved(origin_mm)
    gain = slices.state.gain
    return {
        "moved mm/median": float(np.median(moved_mm)),
        "moved mm/most": float(moved_mm.max()),
        "turned degrees/median": float(np.median(turned_deg)),
        "turned degrees/most": float(turned_deg.max()),
        "gain/median": float(np.median(gain)),
        "gain/lowest": float(gain.min()),
        "gain/highest": float(gain.max()),
        "weight/lowest": float(slices.state.slice_weight.min()),
    }
