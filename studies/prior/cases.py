"""`python -m studies.prior.cases`: with and without the prior on the cases of the test data."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from g3r.bench.record import markdown_table, put_between_markers, write_json, write_text
from studies.command import parser_of, run_command
from studies.motion.layers import THICKNESS_MM
from studies.prior.ablation import BASELINE, VARIANTS, measure

MAX_LOSS_DB = 0.1
"""From several stacks the prior may not cost more than this."""


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = parser_of(
        "prior_cases",
        "Every variant of studies.prior.ablation on the cases, with all their stacks.",
        Path("runs") / "bench" / "prior-cases",
    )
    parser.add_argument("--cases", nargs="+", metavar="WORD", default=[""], help="names that contain one")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command("prior_cases", _run, build_parser().parse_args(argv))


def _run(options: argparse.Namespace) -> int:
    from g3r.bench.record import available_cores, machine, use_threads
    from g3r.checkpoints.weights_file import SHIPPED_PRIOR
    from g3r.evaluation.case import load_case
    from studies.prior.volumes import file_digest
    from studies.runs import preset_settings
    from studies.subjects import test_data_folder

    threads = options.threads or available_cores()
    use_threads(threads)
    settings = preset_settings(options.preset)
    rows: dict[str, Any] = {}
    record = {
        "preset": options.preset,
        "weights": file_digest(Path(options.ckpt or SHIPPED_PRIOR)),
        "threads": threads,
        "machine": machine(),
        "cases": rows,
    }
    for folder in sorted((test_data_folder() / "cases").iterdir()):
        if not any(word in folder.name for word in options.cases):
            continue
        case = load_case(folder, THICKNESS_MM.get(folder.name))
        rows[folder.name] = {"n_stacks": len(case.stacks), **measure(case, settings, options.ckpt)}
        print(folder.name, rows[folder.name], flush=True)
        write_json(options.output / "cases.json", record)
    text = cases_table(record)
    write_text(options.output / "cases.md", text)
    print(text)
    if options.docs:
        put_between_markers(options.docs, "cases", text)
    return 0


def cases_table(record: Mapping[str, Any]) -> str:
    """A row per case: dB of every variant, what the prior brings, median TRE; a loss is marked (!)."""
    rows = []
    for name, row in record["cases"].items():
        psnr = {variant: row["scores"][variant]["psnr_db"] for variant in VARIANTS}
        gain = psnr[VARIANTS[-1]] - psnr[BASELINE]
        mark = " (!)" if gain < -MAX_LOSS_DB else ""
        rows.append(
            [
                name,
                row["n_stacks"],
                *(f"{psnr[variant]:.2f}" for variant in VARIANTS),
                f"{gain:+.2f}{mark}",
                f"{row['scores'][VARIANTS[-1]]['ssim']:.3f}",
                f"{row['median_mm'][VARIANTS[-1]]:.2f}",
            ]
        )
    head = ["case", "stacks", *VARIANTS, "prior brings", "SSIM", "TRE, mm"]
    return (
        f"dB; preset `{record['preset']}`, weights {record['weights']}. (!) marks a loss of more than "
        f"{MAX_LOSS_DB:g} dB.\n\n{markdown_table(head, rows)}"
    )


if __name__ == "__main__":
    sys.exit(main())
