"""The stages of a run: what each gives, its own random numbers, and files to go on from."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Planes, Slices
from g3r.errors import InputError
from g3r.fitting.initial_volumes import FitStart
from g3r.fitting.slice_stage import SliceFit
from g3r.gaussians import GaussianCloud
from g3r.geometry import RigidPose, VolumeGrid
from g3r.output.record import Clock
from g3r.registration import Registration
from g3r.registration.atlas_frame import Orientation
from g3r.run.stage_file import UnreadableStage, as_stored, read_stage, write_stage

logger = logging.getLogger(__name__)

NAMES = ("motion", "prior", "fit to prior", "fit to slices", "prior share")
"""In their order; the first four are kept in files."""

Result = TypeVar("Result")


@dataclass(frozen=True)
class PriorVolume:
    """What the fit starts from and is drawn to.

    start: slices as they are fitted, and the volumes that they give; prior [I, J, K] on its grid, V_sharp
    without a network; gain [K]; scale, what intensities were divided by since motion; believed, whether
    slices of a single stack moved to the prior (None where that was not tried).
    """

    start: FitStart
    prior: NDArray[np.float32]
    gain: NDArray[np.float64]
    scale: float
    accepted: bool | None


@dataclass(frozen=True)
class PriorCloud:
    """The cloud that stage 1 of the fit gives, the loss of each step, and how its Gaussians came about."""

    cloud: GaussianCloud
    history: list[float]
    counts: dict[str, Any]


RECORDS = (
    Registration,
    PriorVolume,
    PriorCloud,
    SliceFit,
    FitStart,
    Slices,
    Planes,
    RigidPose,
    Orientation,
    VolumeGrid,
    GaussianCloud,
)
"""What files of stages may hold."""


def stage_rng(seed: int, stage: str) -> np.random.Generator:
    """The random numbers of one stage: the same whether or not the stages before it ran in this process."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(NAMES.index(stage),)))


class Stages:
    """Runs stages, and keeps what they give in a folder where there is one.

    Args:
        clock: of the run; seconds of a stage that is read are those that it took to make.
        folder: for the files; None keeps nothing.
        provenance: everything that decides the results, by name; None keeps nothing.
        resume: whether to take the stages that are there already, rather than to begin anew.

    Raises:
        InputError: stages that were made of something else.
    """

    def __init__(
        self,
        clock: Clock | None = None,
        folder: Path | None = None,
        provenance: Mapping[str, str] | None = None,
        *,
        resume: bool = False,
    ) -> None:
        self.clock = clock or Clock()
        self.folder = folder
        self.resumed: list[str] = []
        if folder is None:
            return
        told = folder / "made_of.json"
        if resume and told.exists():
            _refuse_other(folder, told, provenance or {})
        self.reads = resume
        self._begin(told, provenance or {})

    def once(self, name: str, make: Callable[[], Result], unless: Callable[[], bool] = lambda: False) -> Result:
        """What a stage gives: read if it was finished, else made, and kept if it can be.

        Args:
            name: of the stage.
            make: what it does.
            unless: whether what was made is not the whole, and must not be kept.
        """
        path = None if self.folder is None else self.folder / f"{name.replace(' ', '-')}.npz"
        if path is not None and self.reads and path.exists():
            try:
                seconds, cpu_seconds, value = read_stage(path, RECORDS)
            except UnreadableStage as error:
                logger.warning("%s; it is made again", error)
            else:
                self.clock.seconds |= seconds
                self.clock.cpu_seconds |= cpu_seconds
                self.resumed.append(name)
                logger.info("%s: taken from the earlier run", name)
                return value
        before = set(self.clock.seconds)
        value = as_stored(make(), RECORDS)
        if path is not None and not unless():
            new = [key for key in self.clock.seconds if key not in before]
            took = tuple({key: told[key] for key in new} for told in (self.clock.seconds, self.clock.cpu_seconds))
            self._keep(path, (*took, value))
        return value

    def _begin(self, told: Path, provenance: Mapping[str, str]) -> None:
        assert self.folder is not None
        try:
            if not self.reads and self.folder.exists():
                for path in self.folder.iterdir():
                    path.unlink()
            self.folder.mkdir(parents=True, exist_ok=True)
            beside = told.with_name(f".{told.name}")
            beside.write_text(json.dumps(dict(provenance), indent=2) + "\n", encoding="utf-8")
            os.replace(beside, told)
        except OSError as error:
            self._give_up(error)

    def _keep(self, path: Path, value: Any) -> None:
        try:
            write_stage(path, value)
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        """Go on without files: the result matters more than a way back to it."""
        logger.warning("%s: stages cannot be kept (%s); --resume will not find them", self.folder, error.strerror)
        self.folder = None


def _refuse_other(folder: Path, told: Path, provenance: Mapping[str, str]) -> None:
    try:
        then = json.loads(told.read_text(encoding="utf-8"))
        differing = sorted(key for key in {*then, *provenance} if then.get(key) != provenance.get(key))
    except (OSError, ValueError, AttributeError, TypeError):
        differing = ["a file that cannot be read"]
    if differing:
        raise InputError(
            f"{folder}: --resume: the earlier run differs in {', '.join(differing)}; pass what it was given, "
            "or leave out --resume to begin anew"
        )
