"""Posed slices with the initial volumes of the baselines, and the resulting volume of a method."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.slicing import normalised_slices
from g3r.acquisition.stacks import Stack
from g3r.evaluation.case import SimulatedCase
from g3r.evaluation.pose_error import PoseError
from g3r.fitting.initial_volumes import InitialVolumes
from g3r.fitting.intensity_matching import match_intensities
from g3r.geometry import RigidPose, VolumeGrid
from g3r.output.result import ReconstructionResult
from g3r.registration import Registration
from studies.paper.least_squares import Regulariser, tuned
from studies.paper.subjects import VOXEL_MM

VOXELS = "voxels"


@dataclass(frozen=True, kw_only=True)
class Made:
    """The resulting volume of a method.

    Attributes:
        name: of the method.
        data: [I, J, K].
        grid: of the data.
        common: the common motion of its slices, from which the alignment to the truth starts.
        seconds: wall time; for baselines without the time for their poses.
        frame: volumes with the same frame have the same slices in the same poses and share one alignment to the truth.
    """

    name: str
    data: NDArray[np.float32]
    grid: VolumeGrid
    common: RigidPose
    seconds: float
    frame: str


@dataclass(frozen=True, kw_only=True)
class Posed:
    """Posed slices for the baselines, and their initial volumes without a network.

    Intensities are matched as in the product: the bias field of each stack and the common bias field are divided out.

    Attributes:
        volumes: initial volumes of the slices.
        gain: [K] intensity factors.
        weight: [K] slice weights.
        widths: width of each stack's profile through the plane, relative to the nominal; None takes the usual widths.
        regularisers: Tikhonov and total variation.
        support: [I, J, K] voxels to which every baseline is cut: the slices' masks and a margin.
        error: of the poses.
        seconds: wall time for these volumes.
    """

    volumes: InitialVolumes
    gain: NDArray[np.float64]
    weight: NDArray[np.float64]
    widths: Sequence[float] | None
    regularisers: tuple[Regulariser, Regulariser]
    support: NDArray[np.bool_]
    error: PoseError
    seconds: float

    @classmethod
    def of(
        cls,
        case: SimulatedCase,
        found: ReconstructionResult | Registration,
        widths: Sequence[float] | None,
        *,
        atlas: bool,
    ) -> Posed:
        """The slices of a case.

        Args:
            case: the subject.
            found: poses, gains and weights of its slices.
            widths: that the product found for its stacks; ignored if it used another number of stacks.
            atlas: whether it comes from an atlas.
        """
        start = time.perf_counter()
        volumes, gain = volumes_without_network(case.stacks, found)
        n_stacks = volumes.slices.n_stacks
        return cls(
            volumes=volumes,
            gain=gain,
            weight=found.weight,
            widths=widths if widths is not None and len(widths) == n_stacks else None,
            regularisers=tuned(atlas, n_stacks),
            support=volumes.foreground.support(),
            error=case.pose_error(volumes.slices),
            seconds=time.perf_counter() - start,
        )

    def made(self, name: str, data: NDArray[np.float32], start: float, frame: str = VOXELS) -> Made:
        """A volume on the grid of the slices' volumes, cut to the support.

        Args:
            name: of the method.
            data: [I, J, K].
            start: start of its computation, in seconds of `time.perf_counter`.
            frame: see `Made`.
        """
        shown = np.where(self.support, data, 0).astype(np.float32)
        seconds = self.seconds + time.perf_counter() - start
        return Made(
            name=name, data=shown, grid=self.volumes.grid, common=self.error.common, seconds=seconds, frame=frame
        )


def volumes_without_network(
    stacks: Sequence[Stack], found: ReconstructionResult | Registration
) -> tuple[InitialVolumes, NDArray[np.float64]]:
    """Initial volumes of posed slices without a network, and the matched gains [K] of the slices.

    Args:
        stacks: all that `found` was given.
        found: poses, gains and weights of their slices.
    """
    slices = normalised_slices(stacks)[0]
    slices = slices.take(np.isin(slices.stack_id, found.slices.stack_id)).with_pose(found.slices.planes.pose)
    matched = match_intensities(slices, found.gain, found.weight)
    return InitialVolumes.of(matched.slices, matched.gain, found.weight, VOXEL_MM), matched.gain
