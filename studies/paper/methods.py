"""All methods on one subject: the product, baselines in the product's poses, and baselines in their own poses."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from g3r.acquisition.planes import volume_from_pixels, volume_planes
from g3r.acquisition.template_fit import fit_template
from g3r.errors import G3RError
from g3r.evaluation.align import Alignment
from g3r.evaluation.case import SimulatedCase
from g3r.fitting.prior_volume import KNOWN_DENSITY, placed_template
from g3r.gaussians import render
from g3r.planning.presets import PRESETS, changed
from g3r.planning.stages import Stage
from g3r.reconstruct import GaussianReconstructor
from g3r.registration import Registration
from studies.harness import Row
from studies.paper.least_squares import least_squares_volume
from studies.paper.pictures import keep_sections
from studies.paper.posed import Made, Posed
from studies.paper.scores import metric, scored
from studies.paper.subjects import PaperSubject, paper_case
from studies.paper.unconstrained import Unconstrained, fit_unconstrained

PRODUCT, PRIOR = "g3r", "V_prior"
SCATTER, SQUARES, VARIATION, FILL = "V_coarse", "least squares, Tikhonov", "least squares, TV", "template fill"
PRINTED, EXACT = "Gaussians alone, B as printed", "Gaussians alone, exact B"
OWN = ", own poses"

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
"""Methods in the order of the tables."""

NO_NETWORK = tuple(name for name in METHODS if name.startswith((SCATTER, SQUARES, VARIATION, FILL)))
UNCONSTRAINED = tuple(name for name in METHODS if name.startswith((PRINTED, EXACT)))

CLASSICAL = {
    "use_prior": False,
    "registration.template": False,
    "registration.network": False,
    "registration.standard_orientation": False,
}
"""Settings of registration without learned parts."""

AFTER_PRIOR = (
    Stage.FIT_TO_PRIOR,
    Stage.HELD_OUT,
    Stage.FIT_TO_SLICES,
    Stage.VOLUME,
    Stage.PRIOR_SHARE,
    Stage.UNCERTAINTY,
)
"""Stages that are not needed for V_prior."""


def measure_methods(spec: PaperSubject, n_stacks: int, options: argparse.Namespace) -> Row:
    """Measure every method on one subject; "skipped" holds the reason if g3r refuses it.

    Args:
        spec: the subject.
        n_stacks: number of its first stacks to use.
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
    stages = {**result.record.seconds, Stage.REGISTRATION: round(registration, 2)}
    widths = result.record.held_out.widths if result.record.held_out else None
    found = Posed.of(case, result, widths, atlas=options.atlas is not None)
    lpips = metric(options.lpips_weights) if options.with_lpips else None
    own = classical_poses(case, widths, options)
    common = found.error.common
    made = [
        Made(name=PRODUCT, data=result.volume, grid=result.grid, common=common, seconds=seconds, frame=PRODUCT),
        Made(
            name=PRIOR,
            data=result.prior,
            grid=result.prior_grid,
            common=common,
            seconds=seconds - sum(stages.get(stage, 0.0) for stage in AFTER_PRIOR),
            frame=PRIOR,
        ),
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


def classical_poses(case: SimulatedCase, widths: Sequence[float] | None, options: argparse.Namespace) -> Posed:
    """The subject's slices in poses of classical registration alone, without networks and templates.

    Args:
        case: the subject.
        widths: of the profiles of its stacks, see `Posed`.
        options: of the command.
    """
    settings = changed(PRESETS[options.preset], CLASSICAL)
    motion = GaussianReconstructor(None, settings).register_stacks(case.stacks)
    return Posed.of(case, motion, widths, atlas=options.atlas is not None)


def template_and_printed(posed: Posed, reconstructor: GaussianReconstructor, motion: Registration) -> Iterator[Made]:
    """The baselines that are made only in the poses of the product: the template, and Eq. 5 as printed.

    Args:
        posed: the slices.
        reconstructor: with the template.
        motion: registration, which places the template.
    """
    volumes = posed.volumes
    start = time.perf_counter()
    placed = placed_template(reconstructor.networks.prior, motion.orientation)
    if placed is not None:
        squares = least_squares_volume(volumes, posed.gain, posed.weight, posed.regularisers[1], posed.widths)
        template = fit_template(placed, volumes.sharp, volumes.share, volumes.density, volumes.grid)
        seen = np.clip(volumes.density / KNOWN_DENSITY, 0, 1)
        yield posed.made(FILL, seen * squares + (1 - seen) * template.values, start)
    yield _gaussians(posed, reconstructor, PRINTED, Unconstrained(attenuation="printed"))


def baselines(posed: Posed, reconstructor: GaussianReconstructor) -> Iterator[Made]:
    """The baselines that need only posed slices.

    Args:
        posed: the slices.
        reconstructor: whose settings determine the number of Gaussians.
    """
    volumes, gain, weight = posed.volumes, posed.gain, posed.weight
    # the sharpest first, because its alignment to the truth is reused for its frame
    for name, regulariser in ((VARIATION, posed.regularisers[1]), (SQUARES, posed.regularisers[0])):
        start = time.perf_counter()
        yield posed.made(name, least_squares_volume(volumes, gain, weight, regulariser, posed.widths), start)
    yield posed.made(SCATTER, volumes.coarse, time.perf_counter())
    yield _gaussians(posed, reconstructor, EXACT, Unconstrained(attenuation="exact"))


def _gaussians(posed: Posed, reconstructor: GaussianReconstructor, name: str, settings: Unconstrained) -> Made:
    start, volumes = time.perf_counter(), posed.volumes
    spacing_mm = reconstructor.settings.lattice.mm(volumes.slices)
    rng = np.random.default_rng(0)
    cloud = fit_unconstrained(volumes, posed.gain, posed.weight, spacing_mm, settings, rng, posed.widths)
    data = volume_from_pixels(render(cloud, volume_planes(volumes.grid)).numpy(), volumes.grid)
    return posed.made(name, data, start, frame=name)  # its poses move with the fit
