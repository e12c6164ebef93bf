"""`python -m studies.tradeoff.convergence`: number of steps that a fit needs to come within 0.1 dB of its end."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from g3r.bench.scores import quality
from g3r.evaluation.case import pose_table
from g3r.planning.presets import PRESETS, changed
from g3r.reconstruct import GaussianReconstructor
from studies.harness import FITS, Record, Row, Study, Task
from studies.runs import registered_once
from studies.subjects import chosen_folders, read_case
from studies.tables import table

STEPS = (10, 20, 40, 80, 160, 320)
"""Numbers of steps. Each is a separate fit, so that its step sizes decay completely."""

NEAR_DB = 0.1

_GAUSSIANS_ALONE = {"held_out": None, "prior_weight": 0.0, "voxel_correction": None}
"""Settings without the corrections after the fit, which take no steps and would repair on voxels a fit with too few."""

_NO_AMPLITUDES = {"prior_stage.amplitude_iterations": 0, "slice_stage.amplitude_iterations": 0}
_UNFITTED = {"use_prior": False, "prior_stage.n_steps": 0}

WAYS: dict[str, Mapping[str, Any]] = {
    "Adam from the seeds": {**_NO_AMPLITUDES, **_UNFITTED},
    "amplitudes by least squares first": _UNFITTED,
    "started at the prior (as shipped)": {},
}
"""Changes of the settings. From one entry to the next the fit gains one part; the first has none of them."""


def steps_to_near(steps: Sequence[int], psnr_db: Sequence[float], goal_db: float) -> float | None:
    """Steps at which a curve first comes within `NEAR_DB` of a goal; interpolated on their logarithm.

    Args:
        steps: ascending.
        psnr_db: at each.
        goal_db: goal of the curve.

    Returns:
        Number of steps, or None if the curve never comes that close.
    """
    target = goal_db - NEAR_DB
    for n in range(len(steps)):
        if psnr_db[n] >= target:
            if n == 0:
                return float(steps[0])
            along = (target - psnr_db[n - 1]) / (psnr_db[n] - psnr_db[n - 1])
            return float(np.exp(np.interp(along, [0, 1], np.log([steps[n - 1], steps[n]]))))
    return None


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per number of steps and way, case by case."""
    for folder in chosen_folders(options.folders):
        for way in WAYS:
            for n_steps in STEPS:
                yield Task(f"{folder.name}, {way}, {n_steps} steps", measure, (folder, way, n_steps, options))


def measure(folder: Path, way: str, n_steps: int, options: argparse.Namespace) -> Row:
    """Measure one fit; all fits of a case use the same registration.

    Args:
        folder: of the case.
        way: key of `WAYS`.
        n_steps: of the slice stage.
        options: of the command.
    """
    case = read_case(folder)
    motion = registered_once(folder, options.preset, options.ckpt)
    own = changed(PRESETS[options.preset], {**_GAUSSIANS_ALONE, **WAYS[way], "slice_stage.n_steps": n_steps})
    result = GaussianReconstructor(options.ckpt, own).reconstruct(case.stacks, motion)
    found = quality(case, result.volume, result.grid.affine, pose_table(result.slices))
    seconds = result.record.cpu_seconds
    return {
        "case": case.name,
        "way": way,
        "steps": n_steps,
        "n_gaussians": len(result.cloud),
        **found.record(),
        "cpu_s": seconds["fit to prior"] + seconds["fit to slices"],
    }


def tables(record: Record) -> dict[str, str]:
    """Table by case and way: dB by steps, and steps and CPU seconds to within 0.1 dB of the best of all."""
    entries = list(record["rows"].values())
    best = {case: max(e["psnr_db"] for e in entries if e["case"] == case) for case in {e["case"] for e in entries}}
    rows = []
    for case, way in dict.fromkeys((e["case"], e["way"]) for e in entries):
        of = sorted((e for e in entries if (e["case"], e["way"]) == (case, way)), key=lambda e: e["steps"])
        steps, psnr = [e["steps"] for e in of], [e["psnr_db"] for e in of]
        row: Row = {"case": case, "way": way, "n_gaussians": of[-1]["n_gaussians"]}
        row |= {f"{e['steps']} steps": e["psnr_db"] for e in of} | {"own": steps_to_near(steps, psnr, max(psnr))}
        common = steps_to_near(steps, psnr, best[case])
        if common is not None:
            seconds = float(np.interp(np.log(common), np.log(steps), [e["cpu_s"] for e in of]))
            row |= {"common": common, "cpu_s": seconds}
        rows.append(row)
    columns: dict[str, Any] = {
        "case": "{case}",
        "fit": "{way}",
        "Gaussians": "{n_gaussians}",
        **{f"{n} steps, dB": f"{{{n} steps:.2f}}" for n in STEPS},
        "steps to its own best": "{own:.0f}",
        "to the best of all": lambda row: f"{row['common']:.0f}" if "common" in row else "never",
        "CPU s of both stages for it": "{cpu_s:.1f}",
    }
    head = (
        f"Preset `{record['preset']}`; steps of the slice stage to within {NEAR_DB:g} dB, interpolated on their "
        "logarithm."
    )
    return {"convergence": f"{head}\n\n{table(rows, columns)}"}


STUDY = Study(
    name="tradeoff.convergence",
    about="Fit subjects with more and more steps, in several ways, after one registration that all share.",
    document="tradeoff.md",
    shared=(*FITS, "folders"),
    tasks=tasks,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
