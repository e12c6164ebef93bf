"""`python -m studies.tradeoff.time_budgets`: whether --time-budget is kept, and what a longer one brings."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from g3r.bench.command_run import infer_arguments, run_infer
from g3r.bench.record import machine, markdown_table, put_between_markers, write_json, write_text
from g3r.bench.scores import quality_of_folder
from g3r.evaluation.case import load_case
from studies.command import parser_of, run_command

BUDGETS_S = (12.0, 15.0, 20.0, 25.0, 30.0, 40.0, 60.0, 120.0)

MORE_SHARE, MORE_S = 0.1, 2.0
"""By how much a budget may be exceeded."""

MAX_LOSS_DB = 0.1
"""By how much a longer budget may be worse than a shorter one."""


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = parser_of(
        "time_budgets",
        "Run g3r-infer with rising time budgets, as a user would.",
        Path("runs") / "bench" / "time-budgets",
    )
    parser.add_argument("cases", nargs="+", type=Path, metavar="CASE", help="folder written by g3r-simulate")
    parser.add_argument("--thickness", type=float, metavar="MM", help="of slices (None: simulation.json)")
    parser.add_argument("--budgets", type=float, nargs="+", metavar="S", default=BUDGETS_S, help="seconds")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command("time_budgets", _run, build_parser().parse_args(argv))


def _run(options: argparse.Namespace) -> int:
    record: dict[str, Any] = {"machine": machine(), "cases": {}}
    output = options.output / "out"
    for folder in options.cases:
        case = load_case(folder, options.thickness)
        plain = infer_arguments(case, "draft", output)
        at = plain.index("--preset")
        rows = record["cases"].setdefault(case.name, [])
        run_infer(plain, output)  # so that kernels are compiled
        for budget_s in sorted(options.budgets):
            given = [*plain[:at], "--time-budget", f"{budget_s:g}", *plain[at + 2 :]]
            run = run_infer(given, output)
            chosen = run.record.time_budget
            assert chosen is not None
            rows.append(
                {
                    "budget_s": budget_s,
                    "seconds": round(run.seconds, 1),
                    "motion": chosen.registration,
                    "fit": chosen.fit,
                    "n_steps": len(run.record.loss["fit to slices"]),
                    "n_gaussians": run.record.n_gaussians,
                    **quality_of_folder(case, output).record(),
                }
            )
            write_json(options.output / "time-budgets.json", record)
    text = budget_table(record["cases"])
    write_text(options.output / "time-budgets.md", text)
    print(text)
    if options.docs:
        put_between_markers(options.docs, "time-budgets", text)
    return 0


def budget_table(cases: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """A row for each budget; (!) marks one that was exceeded, or a volume worse than a shorter one's."""
    rows = []
    for case, entries in cases.items():
        best = float("-inf")
        for entry in entries:
            late = entry["seconds"] > (1 + MORE_SHARE) * entry["budget_s"] + MORE_S
            worse = entry["psnr_db"] < best - MAX_LOSS_DB
            best = max(best, entry["psnr_db"])
            rows.append(
                [
                    case,
                    f"{entry['budget_s']:g}",
                    f"{entry['seconds']:.1f}{' (!)' if late else ''}",
                    entry["motion"],
                    entry["fit"],
                    entry["n_steps"],
                    f"{entry['n_gaussians']:,}",
                    f"{entry['psnr_db']:.2f}{' (!)' if worse else ''}",
                ]
            )
    head = ["case", "budget, s", "took, s", "registration as in", "Gaussians as in", "steps", "Gaussians", "PSNR, dB"]
    return (
        f"{markdown_table(head, rows)}\n\nWhole command, one run each, kernels compiled. (!): more than "
        f"{MORE_SHARE:.0%} and {MORE_S:g} s over the budget, or more than {MAX_LOSS_DB:g} dB below a "
        "shorter one."
    )


if __name__ == "__main__":
    raise SystemExit(main())
