"""All methods on one subject: the product, baselines in its poses, and baselines in poses of their own."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import volume_from_pixels, volume_planes
from g3r.acquisition.slicing import normalised_slices
from g3r.errors import G3RError
from g3r.evaluation.align import Alignment
from g3r.evaluation.case import SimulatedCase
from g3r.evaluation.pose_error import PoseError
from g3r.fitting.initial_volumes import InitialVolumes
from g3r.fitting.prior_volume import KNOWN_DENSITY, placed_template
from g3r.gaussians import render
from g3r.geometry import RigidPose, VolumeGrid
from g3r.output.result import ReconstructionResult
from g3r.planning.presets import PRESETS, changed
from g3r.reconstruct import GaussianReconstructor
from g3r.registration import Registration
from studies.harness import Row
from studies.paper.least_squares import Regulariser, least_squares_volume, tuned
from studies.paper.pictures import keep_sections
from studies.paper.scores import metric, scored
from studies.paper.subjects import VOXEL_MM, PaperSubject, paper_case
from studies.paper.unconstrained import Unconstrained, fit_unconstrained

PRODUCT, PRIOR = "g3r", "V_prior"
SCATTER, SQUARES, VARIATION, FILL = "V_coarse", "least squares, Tikhonov", "least squares, TV", "template fill"
PRINTED, EXACT = "Gaussians alone, B as printed", "Gaussians alone, exact B"
OWN = ", own poses"
VOXELS = "voxels"

METHODS = (
    PRODUCT,
    PRIOR,
    SCATTER,
    SQUARES,
    VARIATION,
    FILL,
    PRINTED,
    EXACT,
    SCATTER + OWN,
    SQUARES + OWN,
    VARIATION + OWN,
    EXACT + OWN,
)
"""In the order of the tables."""

NO_NETWORK = tuple(name for name in METHODS if name.startswith((SCATTER, SQUARES, VARIATION, FILL)))
UNCONSTRAINED = tuple(name for name in METHODS if name.startswith((PRINTED, EXACT)))

CLASSICAL = {
    "use_prior": False,
    "registration.template": False,
    "registration.network": False,
    "registration.standard_orientation": False,
}
"""Registration without anything that was learned."""


@dataclass(frozen=True, kw_only=True)
class Made:
    """A volume of a method.

    Attributes:
        name: of the method.
        data: [I, J, K].
        grid: of the data.
        common: the common motion of its slices, from where the alignment to the truth starts.
        seconds: wall time, without that of poses which it was given.
        frame: volumes of one frame are of the same slices in the same poses, and share one alignment to the truth.
    """

    name: str
    data: NDArray[np.float32]
    grid: VolumeGrid
    common: RigidPose
    seconds: float
    frame: str


@dataclass(frozen=True, kw_only=True)
class Posed:
    """Slices in poses that baselines take, and the volumes that they give by themselves.

    Attributes:
        volumes: of the slices.
        gain: [K] intensity factors.
        weight: [K] slice weights.
        regularisers: Tikhonov's and total variation.
        support: [I, J, K] what is shown of each baseline: the slices' masks and a margin.
        error: of the poses.
    """

    volumes: InitialVolumes
    gain: NDArray[np.float64]
    weight: NDArray[np.float64]
    regularisers: tuple[Regulariser, Regulariser]
    support: NDArray[np.bool_]
    error: PoseError

    @classmethod
    def of(cls, case: SimulatedCase, found: ReconstructionResult | Registration, *, atlas: bool) -> Posed:
        """The slices of a case.

        Args:
            case: the subject.
            found: poses, gains and weights of its slices.
            atlas: whether it comes from an atlas.
        """
        slices = normalised_slices(case.stacks)[0]
        slices = slices.take(np.isin(slices.stack_id, found.slices.stack_id)).with_pose(found.slices.planes.pose)
        volumes = InitialVolumes.of(slices, found.gain, found.weight, VOXEL_MM)
        return cls(
            volumes=volumes,
            gain=found.gain,
            weight=found.weight,
            regularisers=tuned(atlas, slices.n_stacks),
            support=volumes.foreground.support(),
            error=case.pose_error(slices),
        )

    def made(self, name: str, data: NDArray[np.float32], start: float, frame: str = VOXELS) -> Made:
        """A volume on the grid of the slices' volumes, cut to the support.

        Args:
            name: of the method.
            data: [I, J, K].
            start: when it was begun, in seconds of `time.perf_counter`.
            frame: see `Made`.
        """
        shown = np.where(self.support, data, 0).astype(np.float32)
        seconds = time.perf_counter() - start
        return Made(
            name=name, data=shown, grid=self.volumes.grid, common=self.error.common, seconds=seconds, frame=frame
        )


def measure_methods(spec: PaperSubject, n_stacks: int, options: argparse.Namespace) -> Row:
    """One subject by every method; "skipped" says why where g3r refuses it.

    Args:
        spec: the subject.
        n_stacks: its first so many.
        options: of the command.
    """
    case = paper_case(spec, options.atlas, options.cache, n_stacks)
    row: Row = {
        "subject": spec.name,
        "weeks": spec.weeks,
        "motion": spec.motion,
        "n_stacks": n_stacks,
        "kind": "methods",
    }
    try:
        return row | _measured(case, options, f"{spec.name}-{n_stacks}")
    except G3RError as error:
        print(f"{spec.name}, {n_stacks}: {error}", flush=True)
        return row | {"skipped": str(error)}


def _measured(case: SimulatedCase, options: argparse.Namespace, name: str) -> Row:
    reconstructor = GaussianReconstructor(options.ckpt, PRESETS[options.preset])
    start = time.perf_counter(), time.process_time()
    motion = reconstructor.register_stacks(case.stacks)
    registration = time.perf_counter() - start[0]
    result = reconstructor.reconstruct(case.stacks, motion)
    seconds, cpu_seconds = time.perf_counter() - start[0], time.process_time() - start[1]
    stages = {**result.record.seconds, "registration": round(registration, 2)}
    found = Posed.of(case, result, atlas=options.atlas is not None)
    lpips = metric(options.lpips_weights) if options.with_lpips else None
    own = classical_poses(case, options)
    common = found.error.common
    made = [
        Made(name=PRODUCT, data=result.volume, grid=result.grid, common=common, seconds=seconds, frame=PRODUCT),
        Made(name=PRIOR, data=result.prior, grid=result.prior_grid, common=common, seconds=seconds, frame=PRIOR),
        *baselines(found, reconstructor),
        *template_and_printed(found, reconstructor, motion),
        *(replace(one, name=one.name + OWN, frame=one.frame + OWN) for one in baselines(own, reconstructor)),
    ]
    scores: dict[str, Row] = {}
    sections = {}
    known: dict[str, Alignment | None] = {}
    for one in made:
        row, comparison = scored(case, one.data, one.grid, one.common, lpips, known.get(one.frame))
        known[one.frame] = comparison.alignment
        scores[one.name] = row | {"seconds": round(one.seconds, 2)}
        sections[one.name] = comparison.volume
    keep_sections(options.output / "sections" / f"{name}.npz", case, sections)
    return {
        "scores": scores,
        "tre_mm": round(found.error.median_mm, 3),
        "own_tre_mm": round(own.error.median_mm, 3),
        "seconds": round(seconds, 1),
        "cpu_seconds": round(cpu_seconds, 1),
        "stages": stages,
        "n_gaussians": len(result.cloud),
        "warned": bool(result.record.warnings),
    }


def classical_poses(case: SimulatedCase, options: argparse.Namespace) -> Posed:
    """The subject in poses of registration alone, without networks and templates."""
    settings = changed(PRESETS[options.preset], CLASSICAL)
    motion = GaussianReconstructor(None, settings).register_stacks(case.stacks)
    return Posed.of(case, motion, atlas=options.atlas is not None)


def template_and_printed(posed: Posed, reconstructor: GaussianReconstructor, motion: Registration) -> Iterator[Made]:
    """The baselines that are made in the poses of the product alone: the template, and Eq. 5 as it is printed.

    Args:
        posed: the slices.
        reconstructor: with the template.
        motion: registration, which says where the template lies.
    """
    volumes = posed.volumes
    start = time.perf_counter()
    placed = placed_template(reconstructor.networks.prior, motion.orientation)
    if placed is not None:
        squares = least_squares_volume(volumes, posed.gain, posed.weight, posed.regularisers[1])
        template = placed.fitted(volumes.sharp, volumes.share, volumes.density, volumes.grid)
        seen = np.clip(volumes.density / KNOWN_DENSITY, 0, 1)
        yield posed.made(FILL, seen * squares + (1 - seen) * template.values, start)
    yield _gaussians(posed, reconstructor, PRINTED, Unconstrained(attenuation="printed"))


def baselines(posed: Posed, reconstructor: GaussianReconstructor) -> Iterator[Made]:
    """The baselines that need nothing but slices in poses.

    Args:
        posed: the slices.
        reconstructor: whose settings say how many Gaussians there are.
    """
    volumes, gain, weight = posed.volumes, posed.gain, posed.weight
    # the sharpest first: its alignment is that of its frame
    for name, regulariser in ((VARIATION, posed.regularisers[1]), (SQUARES, posed.regularisers[0])):
        start = time.perf_counter()
        yield posed.made(name, least_squares_volume(volumes, gain, weight, regulariser), start)
    yield posed.made(SCATTER, volumes.coarse, time.perf_counter())
    yield _gaussians(posed, reconstructor, EXACT, Unconstrained(attenuation="exact"))


def _gaussians(posed: Posed, reconstructor: GaussianReconstructor, name: str, settings: Unconstrained) -> Made:
    start, volumes = time.perf_counter(), posed.volumes
    spacing_mm = reconstructor.settings.lattice.mm(volumes.slices)
    cloud = fit_unconstrained(volumes, posed.gain, posed.weight, spacing_mm, settings, np.random.default_rng(0))
    data = volume_from_pixels(render(cloud, volume_planes(volumes.grid)).numpy(), volumes.grid)
    return posed.made(name, data, start, frame=name)  # its poses move with the fit
