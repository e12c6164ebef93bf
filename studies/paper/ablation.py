"""Ablation of Fig. 4A: the product without its parts, from three, two and one stacks, after one common registration."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
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

ANNEALED: Mapping[str, Any] = {"several_stacks_distilled": True, "slice_stage.prior_error": 0.0}

VARIANTS: dict[str, Mapping[str, Any]] = {
    SHIPPED: {},
    LINEAR: ANNEALED,
    CONSTANT: {**ANNEALED, "slice_stage.distillation": CONSTANT_WEIGHT},
    NONE: {"distillation": False},
    NO_PRIOR: {"use_prior": False},
    HELD_STILL: {"pose_rounds.single_stack": 0, "slice_stage.optimise_poses": False},
}
"""Variants as changes of the settings. LINEAR anneals as in the paper, CONSTANT does not anneal. The shipped settings
leave distillation out from several stacks, so NONE is the same there, and is not run again. Slices of a single stack
move after registration only if distillation holds the volume (`adapted`), so its variant without distillation is to be
compared with the variant in which slices stay."""

FOR_SINGLE = (HELD_STILL,)
"""Variants for a single stack only."""


def measure_variants(spec: PaperSubject, n_stacks: int, options: argparse.Namespace) -> Row:
    """Measure every variant on one subject; "skipped" holds the reason if g3r refuses it.

    Args:
        spec: the subject.
        n_stacks: number of its first stacks to use.
        options: of the command.
    """
    row: Row = {"subject": spec.name, "motion": spec.motion, "n_stacks": n_stacks, "kind": "variants"}
    case = paper_case(spec, options.atlas, options.cache, n_stacks)
    settings = PRESETS[options.preset]
    scores: dict[str, Row] = {}
    seconds: dict[str, float] = {}
    try:
        motion = GaussianReconstructor(options.ckpt, settings).register_stacks(case.stacks)
        for name, changes in VARIANTS.items():
            if n_stacks > 1 and name in FOR_SINGLE:
                continue
            if n_stacks > 1 and name == NONE:
                scores[NONE], seconds[NONE] = scores[SHIPPED], seconds[SHIPPED]
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
