"""`python -m studies.tradeoff.convergence`: how many steps a fit needs to within 0.1 dB of where it ends."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from g3r.bench.record import machine, markdown_table, put_between_markers, write_json, write_text
from g3r.bench.scores import quality
from g3r.evaluation.case import load_case, pose_table
from g3r.planning.presets import changed
from g3r.reconstruct import GaussianReconstructor
from studies.command import parser_of, run_command
from studies.runs import preset_settings

STEPS = (10, 20, 40, 80, 160, 320)
"""Each is a fit of its own, so that its step sizes fall to their end."""

NEAR_DB = 0.1

_LATTICE = {"adaptive": None}
_NO_AMPLITUDES = {"prior_stage.amplitude_iterations": 0, "slice_stage.amplitude_iterations": 0}
_UNFITTED = {"use_prior": False, "prior_stage.n_steps": 0}

WAYS: dict[str, Mapping[str, Any]] = {
    "Adam from the seeds": {**_LATTICE, **_NO_AMPLITUDES, **_UNFITTED},
    "amplitudes by least squares first": {**_LATTICE, **_UNFITTED},
    "started at the prior": _LATTICE,
    "few Gaussians first (as shipped)": {},
}
"""Changes of the settings, one more thing at a time; the first is what a fit without any of them is."""


def steps_to_near(steps: Sequence[int], psnr_db: Sequence[float], goal_db: float) -> float | None:
    """Steps at which a curve first comes within `NEAR_DB` of a goal; interpolated on their logarithm.

    Args:
        steps: ascending.
        psnr_db: at each.
        goal_db: to come near to.

    Returns:
        None where it never does.
    """
    target = goal_db - NEAR_DB
    for n in range(len(steps)):
        if psnr_db[n] >= target:
            if n == 0:
                return float(steps[0])
            along = (target - psnr_db[n - 1]) / (psnr_db[n] - psnr_db[n - 1])
            return float(np.exp(np.interp(along, [0, 1], np.log([steps[n - 1], steps[n]]))))
    return None


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = parser_of(
        "fit_convergence",
        "Fit subjects with more and more steps, in several ways, after one registration that all share.",
        Path("runs") / "bench" / "fit-convergence",
    )
    parser.add_argument("cases", nargs="+", type=Path, metavar="CASE", help="folder written by g3r-simulate")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command("fit_convergence", _run, build_parser().parse_args(argv))


def _run(options: argparse.Namespace) -> int:
    settings = preset_settings(options.preset)
    record: dict[str, Any] = {"preset": options.preset, "machine": machine(), "cases": {}}
    for folder in options.cases:
        case = load_case(folder)
        motion = GaussianReconstructor(options.ckpt, settings).register_stacks(case.stacks)
        rows = record["cases"].setdefault(case.name, {})
        for name, options_of_way in WAYS.items():
            rows[name] = []
            for n_steps in STEPS:
                own = changed(settings, {**options_of_way, "slice_stage.n_steps": n_steps})
                result = GaussianReconstructor(options.ckpt, own).reconstruct(case.stacks, motion)
                found = quality(case, result.volume, result.grid.affine, pose_table(result.slices))
                seconds = result.record.cpu_seconds
                rows[name].append(
                    {
                        "steps": n_steps,
                        "n_gaussians": len(result.cloud),
                        **found.record(),
                        "cpu_s": seconds["fit to prior"] + seconds["fit to slices"],
                    }
                )
                print(case.name, name, rows[name][-1], flush=True)
                write_json(options.output / "convergence.json", record)
    text = convergence_table(record)
    write_text(options.output / "convergence.md", text)
    print(text)
    if options.docs:
        put_between_markers(options.docs, "convergence", text)
    return 0


def convergence_table(record: Mapping[str, Any]) -> str:
    """For each case and way: dB by steps, and steps and CPU seconds to within 0.1 dB of the best of all."""
    rows = []
    for case, ways in record["cases"].items():
        best = max(entry["psnr_db"] for entries in ways.values() for entry in entries)
        for name, entries in ways.items():
            steps = [entry["steps"] for entry in entries]
            psnr = [entry["psnr_db"] for entry in entries]
            own, common = steps_to_near(steps, psnr, max(psnr)), steps_to_near(steps, psnr, best)
            seconds = None
            if common is not None:
                seconds = float(np.interp(np.log(common), np.log(steps), [e["cpu_s"] for e in entries]))
            rows.append(
                [
                    case,
                    name,
                    entries[-1]["n_gaussians"],
                    *(f"{value:.2f}" for value in psnr),
                    f"{own:.0f}",
                    "never" if common is None else f"{common:.0f}",
                    "" if seconds is None else f"{seconds:.1f}",
                ]
            )
    head = [
        "case",
        "fit",
        "Gaussians",
        *(f"{n} steps, dB" for n in STEPS),
        "steps to its own best",
        "to the best of all",
        "CPU s of both stages for it",
    ]
    return (
        f"Preset `{record['preset']}`; steps of the slice stage to within {NEAR_DB:g} dB, interpolated on "
        f"their logarithm.\n\n{markdown_table(head, rows)}"
    )


if __name__ == "__main__":
    raise SystemExit(main())
