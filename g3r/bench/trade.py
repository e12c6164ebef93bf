"""`g3r-bench trade`: seconds, memory and quality of every preset, and of sweeps around one of them."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g3r.bench.record import add_output_arguments, run_measurement
from g3r.errors import InputError
from g3r.planning import PRESET_NAMES

if TYPE_CHECKING:
    from g3r.evaluation.case import SimulatedCase

OUTSIDE_STAGES = "start-up, reading, writing"
"""Name of the time outside the stages of run.json."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("cases", nargs="*", type=Path, metavar="CASE", help="folders of g3r-simulate")
    add_output_arguments(parser, "trade", "PSNR against seconds")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each command; medians are shown")
    parser.add_argument("--presets", nargs="+", choices=PRESET_NAMES, default=PRESET_NAMES, metavar="PRESET")
    parser.add_argument("--sweeps", action="store_true", help="on the first case: sweeps, and curves of fits")
    parser.add_argument("--base", choices=PRESET_NAMES, default="balanced", help="preset whose fit sweeps vary")
    parser.add_argument("--thickness", type=float, metavar="MM", help="of slices (None: simulation.json)")
    parser.add_argument("--threads", type=int, help="CPU threads (None: all cores)")


def run(options: argparse.Namespace) -> int:
    """Measure, and write the results; returns the exit code."""
    from g3r.bench.trade_figure import draw_trade
    from g3r.bench.trade_tables import trade_tables

    measure = lambda keep: _measure(options, keep)  # noqa: E731
    return run_measurement(options, "trade", measure=measure, tables=trade_tables, draw=draw_trade)


def _measure(options: argparse.Namespace, keep: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    from g3r.bench.command_run import infer_arguments, run_infer
    from g3r.bench.record import machine
    from g3r.evaluation.case import load_case
    from g3r.planning.presets import PRESETS
    from g3r.run.machine import available_cores, use_up_to

    if not options.cases:
        raise InputError("no case given; expected folders written by g3r-simulate")
    if options.repeats < 1:
        raise InputError(f"--repeats {options.repeats}; expected at least 1")
    if not PRESETS[options.base].n_lattices:
        fitting = ", ".join(name for name, settings in PRESETS.items() if settings.n_lattices)
        raise InputError(
            f"--base {options.base}: this preset has no fit that sweeps could vary; choose one of {fitting}"
        )
    cases = [load_case(folder, options.thickness) for folder in options.cases]
    for case in cases:
        _ = case.truth_mask  # fails before any work
    threads = options.threads or available_cores()
    record: dict[str, Any] = {
        "machine": machine(threads),
        "repeats": options.repeats,
        "base": options.base,
        "cases": {},
    }
    with tempfile.TemporaryDirectory(prefix="g3r-bench-") as scratch:
        output = Path(scratch) / "result"
        more = [] if options.threads is None else ["--threads", str(threads)]
        _say("once without measuring, so that kernels are compiled and files cached")
        run_infer([*infer_arguments(cases[0], "preview", output), *more], output)
        for case in cases:
            rows: dict[str, Any] = {}
            record["cases"][case.name] = {"n_stacks": len(case.stacks), "presets": rows}
            for preset in options.presets:
                _say(f"{case.name}: {preset}")
                arguments = [*infer_arguments(case, preset, output), *more]
                rows[preset] = measured_command(case, arguments, output, options.repeats)
                keep(record)
    if options.sweeps:
        use_up_to(threads)
        _measure_fits(cases[0], options, record, keep)
    return record


def measured_command(case: SimulatedCase, arguments: list[str], output: Path, repeats: int) -> dict[str, Any]:
    """Medians over runs of one command, and the quality of the last run's result.

    Args:
        case: simulated subject.
        arguments: arguments of g3r-infer.
        output: its output folder.
        repeats: number of runs.
    """
    from statistics import median

    from g3r.bench.command_run import run_infer
    from g3r.bench.scores import quality_of_folder

    runs = [run_infer(arguments, output) for _ in range(repeats)]
    names = list(runs[-1].record.seconds)
    wall, cpu = median(run.seconds for run in runs), median(run.cpu_seconds for run in runs)
    stages = {name: round(median(run.record.seconds[name] for run in runs), 3) for name in names}
    stages_cpu = {name: round(median(run.record.cpu_seconds[name] for run in runs), 3) for name in names}
    stages[OUTSIDE_STAGES] = round(wall - sum(stages.values()), 3)
    stages_cpu[OUTSIDE_STAGES] = round(cpu - sum(stages_cpu.values()), 3)
    return {
        "seconds": round(wall, 3),
        "cpu_seconds": round(cpu, 3),
        "all_seconds": [round(run.seconds, 3) for run in runs],
        "peak_bytes": max(run.peak_bytes for run in runs),
        "stages": stages,
        "stages_cpu": stages_cpu,
        "n_gaussians": runs[-1].record.n_gaussians,
        **quality_of_folder(case, output).record(),
    }


def _measure_fits(
    case: SimulatedCase, options: argparse.Namespace, record: dict[str, Any], keep: Callable[[dict[str, Any]], None]
) -> None:
    """Add to the record of a case the curves during the fit of each preset with a fit, and the sweeps."""
    from g3r.bench.fits import measured_fit, measured_sweeps
    from g3r.planning.presets import PRESETS

    found = record["cases"][case.name]
    found["fits"] = {}
    for preset in options.presets:
        if not PRESETS[preset].n_lattices:
            continue
        _say(f"{case.name}: quality during the fit, {preset}")
        found["fits"][preset] = measured_fit(case, PRESETS[preset])
        keep(record)
    _say(f"{case.name}: sweeps around {options.base}")
    found["sweeps"] = {}
    for sweep, label, figures in measured_sweeps(case, PRESETS[options.base]):
        found["sweeps"].setdefault(sweep, {})[label] = figures
        keep(record)


def _say(line: str) -> None:
    print(f"g3r-bench trade: {line}", file=sys.stderr, flush=True)
