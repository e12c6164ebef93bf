"""Ablation of Fig. 4A: the product without its parts, from three, two and one stacks, after one common registration."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from g3r.errors import G3RError
from g3r.fitting.schedules import AnnealedWeight
from g3r.planning.presets import PRESETS, changed
from g3r.reconstruct import GaussianReconstructor
from studies.harness import Row
from studies.paper.subjects import PaperSubject, paper_case
from studies.runs import aligned, figures

SHIPPED, LINEAR, CONSTANT = "as shipped", "annealing linear", "annealing constant"
NONE, NO_PRIOR = "no annealing: without distillation", "without prior"
HELD_STILL = "slices stay where the prior has them"

CONSTANT_WEIGHT = AnnealedWeight(0.2, 0.2)

VARIANTS: dict[str, Mapping[str, Any]] = {
    SHIPPED: {},
    LINEAR: {"slice_stage.prior_error": 0.0},
    CONSTANT: {"slice_stage.prior_error": 0.0, "slice_stage.distillation": CONSTANT_WEIGHT},
    NONE: {"distillation": False},
    NO_PRIOR: {"use_prior": False},
    HELD_STILL: {"pose_rounds.single_stack": 0, "slice_stage.optimise_poses": False},
}
"""Variants as changes of the settings. With several stacks the shipped settings anneal linearly, as in the paper.
Slices of a single stack move after registration only if distillation holds the volume (`adapted`), so the variant
without distillation is to be compared with the variant in which slices stay."""

FOR_SINGLE = (LINEAR, HELD_STILL)
"""Variants for a single stack only. LINEAR is the shipped annealing for several stacks; HELD_STILL is the reference for
the variant without distillation."""


def measure_variants(spec: PaperSubject, n_stacks: int, options: argparse.Namespace) -> Row:
    """Measure every variant on one subject; "skipped" holds the reason if g3r refuses it.

    Args:
        spec: the subject.
        n_stacks: number of its first stacks to use.
        options: of the command.
    """
    row: Row = {"subject": spec.name, "motion": spec.motion, "n_stacks": n_stacks, "kind": "variants"}
    case = paper_case(spec, options.atlas, options.cache, n_stacks)
    # variants of the annealing make sense only where two stacks are held to the prior, too
    settings = replace(PRESETS[options.preset], two_stacks_distilled=True)
    scores, seconds = {}, {}
    try:
        motion = GaussianReconstructor(options.ckpt, settings).register_stacks(case.stacks)
        for name, changes in VARIANTS.items():
            if n_stacks > 1 and name in FOR_SINGLE:
                continue
            start = time.perf_counter()
            result = GaussianReconstructor(options.ckpt, changed(settings, changes)).reconstruct(case.stacks, motion)
            seconds[name] = round(time.perf_counter() - start, 2)
            common = case.pose_error(result.slices).common
            scores[name] = figures(aligned(case, result.volume, result.grid, common).scores)
    except G3RError as error:
        print(f"{spec.name}, {n_stacks}: {error}", flush=True)
        return row | {"skipped": str(error)}
    return row | {"scores": scores, "seconds": seconds}
