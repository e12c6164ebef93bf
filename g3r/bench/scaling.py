"""`g3r-bench scaling`: time and memory as Gaussians, slices, pixels and output voxels grow, one at a time."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from g3r.bench.record import add_output_arguments, machine, run_measurement
from g3r.errors import InputError
from g3r.run.machine import use_up_to

if TYPE_CHECKING:
    from g3r.acquisition.planes import Planes, Slices
    from g3r.bench.scenes import SceneSize
    from g3r.gaussians import GaussianCloud

STEP, SEARCH, AMPLITUDES, WRITING = "optimiser step", "overlap search", "amplitudes", "volume"
"""Measured operations: forward, backward and update; `find_overlaps`; `solve_amplitudes`; `render` of a volume."""

GROWING: dict[str, tuple[str, int, tuple[str, ...]]] = {
    "Gaussians": ("n_gaussians", 500, (STEP, SEARCH, AMPLITUDES, WRITING)),
    "slices": ("n_slices", 6, (STEP, SEARCH, AMPLITUDES)),
    "pixels per slice": ("n_pixels", 1024, (STEP, AMPLITUDES)),
    "output voxels": ("n_voxels", 27_000, (WRITING,)),
}
"""Sizes that grow: the field of `SceneSize`, the smallest size, and the operations that should grow with it."""

PIXEL_FIELDS = ("n_pixels", "n_voxels")
"""Sizes that leave the number of pairs (nearly) unchanged, so that the set-up of pairs does not grow."""

N_SIZES = 8
"""Number of sizes, each twice the one before: 2^7 = 128, two decades."""

AMPLITUDE_ITERATIONS = 4
TIMED_STEPS = 6

MIN_EXPONENT, MAX_EXPONENT = 0.9, 1.15


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_output_arguments(parser, "scaling", "seconds against size")
    parser.add_argument("--sizes", type=int, default=N_SIZES, help="how many, each twice the one before")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads; seconds are CPU time of all")


def run(options: argparse.Namespace) -> int:
    """Measure, and write the results; returns the exit code."""
    from g3r.bench.scaling_tables import draw_scaling, scaling_tables

    if options.sizes < 2:
        raise InputError(f"--sizes {options.sizes}; expected at least 2, for a slope")
    if options.threads < 1:
        raise InputError(f"--threads {options.threads}; expected at least 1")
    measure = lambda keep: _measure(options, keep)  # noqa: E731
    return run_measurement(options, "scaling", measure=measure, tables=scaling_tables, draw=draw_scaling)


def _measure(options: argparse.Namespace, keep: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    use_up_to(options.threads)
    record: dict[str, Any] = {"machine": machine(options.threads), "growing": {}}
    for name in GROWING:
        print(f"g3r-bench scaling: {name}", file=sys.stderr, flush=True)
        record["growing"][name] = measured_growth(name, options.sizes)
        keep(record)
    return record


def measured_growth(name: str, n_sizes: int = N_SIZES) -> list[dict[str, Any]]:
    """A row per size: `size`, `pairs`, `evaluations`, and of each operation `seconds` and `bytes`.

    If pixels grow and pairs do not, also `setup_seconds`: seconds of the same pairs with four pixels per plane.
    """
    from g3r.bench.scenes import SceneSize

    field, smallest, operations = GROWING[name]
    base = SceneSize(n_slices=12) if field == "n_pixels" else SceneSize()
    wanted = [smallest * 2**k for k in range(n_sizes)]
    return [measured_scene(replace(base, **{field: n}), field, operations) for n in wanted]


def measured_scene(size: SceneSize, field: str, operations: tuple[str, ...]) -> dict[str, Any]:
    """One size: work, seconds and memory of each operation.

    Args:
        size: size of the scene.
        field: field of `SceneSize` that grows.
        operations: operations to measure.
    """
    from g3r.bench.cost import peak_extra_bytes
    from g3r.bench.scenes import corner_slices, corners, evaluations, made_cloud, made_slices, made_volume_planes
    from g3r.gaussians import find_overlaps
    from g3r.gaussians.render import CUTOFF_SIGMA

    cloud = made_cloud(size)
    volume, slices = made_volume_planes(size), made_slices(size, cloud)
    planes = volume if operations == (WRITING,) else slices.planes
    overlaps = find_overlaps(cloud, planes, CUTOFF_SIGMA)
    calls = scene_calls(cloud, slices, volume)
    row: dict[str, Any] = {
        "size": _actual(field, size, slices.planes.shape[0], volume.shape[0]),
        "pairs": len(overlaps),
        "evaluations": evaluations(cloud, planes, CUTOFF_SIGMA)[0],
        "seconds": {name: calls[name][0]() for name in operations},
        "bytes": {name: peak_extra_bytes(calls[name][1]) for name in operations},
    }
    if field in PIXEL_FIELDS:
        bare = scene_calls(cloud, corner_slices(slices), corners(volume))
        row["setup_seconds"] = {name: bare[name][0]() for name in operations}
    return row


def scene_calls(
    cloud: GaussianCloud, slices: Slices, volume: Planes
) -> dict[str, tuple[Callable[[], float], Callable[[], object]]]:
    """For each operation, a function that returns its seconds, and a function that calls it once.

    Args:
        cloud: Gaussians.
        slices: slices that are fitted.
        volume: planes of the written volume.
    """
    from g3r.bench.cost import min_cpu_seconds
    from g3r.gaussians import find_overlaps, render, solve_amplitudes
    from g3r.gaussians.render import CUTOFF_SIGMA

    weight = slices.mask.astype("float32")
    overlaps = find_overlaps(cloud, slices.planes, CUTOFF_SIGMA)
    single: dict[str, Callable[[], object]] = {
        SEARCH: lambda: find_overlaps(cloud, slices.planes, CUTOFF_SIGMA),
        AMPLITUDES: lambda: solve_amplitudes(
            cloud, slices.planes, slices.value, weight, n_iterations=AMPLITUDE_ITERATIONS, overlaps=overlaps
        ),
        WRITING: lambda: render(cloud, volume),
    }

    def timed(call: Callable[[], object]) -> Callable[[], float]:
        return lambda: min_cpu_seconds(call)

    step = lambda: step_seconds(cloud, slices)  # noqa: E731
    return {STEP: (step, step), **{name: (timed(call), call) for name, call in single.items()}}


def step_seconds(cloud: GaussianCloud, slices: Slices) -> float:
    """CPU seconds of one optimiser step: the least of several in a fit, without the start of the fit.

    Forward, backward and update of all parameters of a fit to the slices; without distillation, and without the search
    for pairs, which does not happen in every step.
    """
    import time

    import numpy as np

    from g3r.fitting.fit_context import FitContext
    from g3r.fitting.slice_stage import SliceStageSettings, fit_slices

    moments: list[float] = []

    class Watch:
        every = 1

        def __call__(self, moment: object) -> None:
            moments.append(time.process_time())

    settings = SliceStageSettings(n_steps=TIMED_STEPS, n_parts=1, amplitude_iterations=0)
    ones = np.ones(len(slices))
    fit_slices(
        cloud,
        slices,
        gain=ones,
        weight=ones,
        prior=None,
        settings=settings,
        context=FitContext(rng=np.random.default_rng(0), observer=Watch()),
    )
    return float(np.diff(moments).min())


def _actual(field: str, size: SceneSize, plane_shape: Any, volume_shape: Any) -> int:
    """The actual size: sides are whole numbers, so pixels and voxels are only near the requested numbers."""
    if field == "n_pixels":
        return int(plane_shape.prod())
    if field == "n_voxels":
        return int(volume_shape[0]) ** 3
    return int(getattr(size, field))
