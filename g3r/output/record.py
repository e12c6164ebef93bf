"""run.json: what is needed to judge a result and to run it again."""

from __future__ import annotations

import logging
import platform
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from g3r._version import __version__
from g3r.acquisition.planes import MIN_SLICE_PIXELS, Slices
from g3r.acquisition.stacks import Stack
from g3r.fitting.slice_stage import SliceFit
from g3r.planning.memory_estimate import peak_bytes
from g3r.planning.presets import ReconstructionSettings
from g3r.pose_network.model import PoseModel
from g3r.prior.model import Prior
from g3r.registration import Registration
from g3r.registration.quality import StackQuality, registration_reliable, registration_summary

logger = logging.getLogger(__name__)


def run_record(
    settings: ReconstructionSettings,
    prior: Prior | None,
    pose: PoseModel | None,
    stacks: Sequence[Stack],
    slices: Slices,
    motion: Registration,
    qualities: list[StackQuality],
    fit: SliceFit,
    clock: Clock,
    notes: list[str],
    warnings: list[str],
) -> dict[str, Any]:
    """run.json: what is needed to judge the result and to run it again; file names only, no paths."""
    of_stack = [slices.stack_id == n for n in range(len(stacks))]
    # motion has an entry for each stack that has slices, which not every given one need have
    place = {int(stack): k for k, stack in enumerate(np.unique(slices.stack_id))}
    return {
        "g3r": __version__,
        "versions": {"python": platform.python_version(), "torch": torch.__version__, "numpy": np.__version__},
        "settings": asdict(settings),
        "prior": prior.record() if prior else None,
        "pose_network": pose.record() if pose else None,
        "stacks": [
            {
                "name": stack.name,
                "thickness_mm": stack.thickness_mm,
                "spacing_mm": [round(float(x), 6) for x in stack.spacing_mm],
                "n_slices": int(chosen.sum()),
                "pose_confidence": qualities[n].record(),
                "interleave": motion.interleave[place[n]] if n in place else None,
                "n_segments": motion.n_segments[place[n]] if n in place else None,
                "n_downweighted_slices": int((fit.weight[chosen] < 0.5).sum()),
            }
            for n, (stack, chosen) in enumerate(zip(stacks, of_stack, strict=True))
        ],
        "shading": fit.bias_field,
        "n_gaussians": len(fit.cloud),
        "n_rollbacks": sum("rollback" in entry for entry in fit.history),
        "registration": {"trusted": registration_reliable(qualities), "summary": registration_summary(qualities)},
        "motion": {
            "start": motion.initialisation,
            "held_out_correlation_by_start": motion.initialisations,
            "orientation": "scanner" if motion.orientation is None else "standard",
            "correlation_with_mean_head": motion.orientation and motion.orientation.correlation,
            "rounds": motion.history,
        },
        "seconds": clock.seconds,
        "cpu_seconds": clock.cpu_seconds,
        "peak_memory_bytes": peak_bytes(),
        "notes": notes,
        "warnings": warnings,
    }


class Clock:
    """Wall and CPU seconds of each stage, and a line in the log when it ends."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.cpu_seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time what is done inside."""
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.seconds[stage] = round(time.perf_counter() - wall, 3)
        self.cpu_seconds[stage] = round(time.process_time() - cpu, 3)
        logger.info("%s: %.1f s", stage, self.seconds[stage])


def skipped_slice_notes(stacks: Sequence[Stack], slices: Slices) -> list[str]:
    """A line for each stack of which slices were left out for want of masked pixels."""
    lines = []
    for n, stack in enumerate(stacks):
        marked = np.flatnonzero(stack.mask.any((0, 1)))
        missing = sorted(set(marked.tolist()) - set(slices.slice_index[slices.stack_id == n].tolist()))
        if missing:
            numbers = ", ".join(map(str, missing))
            lines.append(f"{stack.name}: slices {numbers} left out, fewer than {MIN_SLICE_PIXELS} masked pixels")
    return lines


def inactive_terms(slices: Slices, settings: ReconstructionSettings, counts: dict[str, Any]) -> list[dict[str, str]]:
    """Which terms of the model are absent, each with the reason: what the data cannot determine.

    Args:
        slices: that were fitted.
        settings: as they were used for these slices.
        counts: how the number of Gaussians came about.
    """
    stage, terms = settings.slice_stage, []
    single = len(np.unique(slices.stack_id)) == 1

    def absent(term: str, reason: str) -> None:
        terms.append({"term": term, "reason": reason})

    if len(slices) == 1:
        absent("gain of the slice", "a single slice: its gain cannot be told from the peaks")
    if single:
        absent("shading", "a single stack cannot tell it from anatomy")
    elif not stage.optimise_bias_field:
        absent("shading", "switched off in the settings")
    if not stage.optimise_poses:
        absent(
            "poses in the fit",
            "a single stack without a prior to hold it drifts" if single else "switched off in the settings",
        )
    if not settings.use_prior:
        absent("distance to the prior", "no prior was asked for")
    elif not settings.distillation:
        absent("distance to the prior", "distillation is switched off in the settings")
    bound = counts.get("bound")
    if bound is not None:
        absent(
            "finer Gaussians",
            f"the prior volume is within {bound:g} (local root mean square) of them for "
            f"{100 * (1 - counts['share_over_bound']):.1f} % of the head, or they stand "
            f"{counts['finest_spacing_mm']:.2f} mm apart, as close as pixels can tell",
        )
    return terms
