"""The lattice against error bounds in the whole reconstruction: PSNR to the truth, Gaussians, CPU seconds."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from g3r.acquisition.images import Volume
from g3r.bench.record import markdown_table
from g3r.evaluation.case import load_case
from g3r.evaluation.compare import compare
from g3r.planning.presets import ADAPTIVE
from g3r.reconstruct import GaussianReconstructor
from studies.command import run_command
from studies.runs import _moved, preset_settings


def run(options: argparse.Namespace) -> int:
    """Register each case once, reconstruct it every way, print a table."""
    settings = preset_settings(options.preset)
    ways = {"lattice": None} | {f"{bound:g}": replace(ADAPTIVE, bound=bound) for bound in options.bounds}
    rows = []
    for folder in options.cases:
        case = load_case(folder)
        motion = GaussianReconstructor(settings=settings).register_stacks(case.stacks)
        for name, adaptive in ways.items():
            reconstructor = GaussianReconstructor(settings=replace(settings, adaptive=adaptive))
            result = reconstructor.reconstruct(case.stacks, motion)
            common = case.pose_error(result.slices).common
            volume = Volume(result.volume, _moved(common, result.grid.affine), case.name)
            scores = compare(volume, case.truth, case.truth_mask, align=True).scores
            seconds = result.record.cpu_seconds
            rows.append(
                [
                    case.name,
                    name,
                    len(result.cloud),
                    f"{scores.psnr_db:.2f}",
                    f"{scores.ssim:.4f}",
                    f"{seconds['fit to prior']:.1f}",
                    f"{seconds['fit to slices']:.1f}",
                ]
            )
    head = ["case", "bound", "Gaussians", "PSNR, dB", "SSIM", "CPU s, stage 1", "CPU s, stage 2"]
    print(markdown_table(head, rows))
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `python -m studies.tradeoff.seeding`."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.tradeoff.seeding",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("cases", nargs="+", type=Path, metavar="CASE", help="folder written by g3r-simulate")
    parser.add_argument("--bounds", nargs="*", type=float, default=[0.03, 0.05, 0.08], help="to compare")
    parser.add_argument("--preset", default="balanced", help="settings")
    return run_command("gaussian_seeding", run, parser.parse_args(argv))


if __name__ == "__main__":
    raise SystemExit(main())
