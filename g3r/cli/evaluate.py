# PYTHON_ARGCOMPLETE_OK
"""`g3r-evaluate`: score a reconstruction against the truth, or by its prediction of a held-out stack."""

from __future__ import annotations

import argparse
import json
import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g3r._version import __version__
from g3r.cli import held_out
from g3r.cli.completion import parsed
from g3r.cli.failures import INTERRUPTED, run_command
from g3r.errors import InputError

if TYPE_CHECKING:
    from g3r.evaluation.compare import Comparison
    from g3r.evaluation.pose_error import PoseError

PROG = "g3r-evaluate"


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = argparse.ArgumentParser(
        prog=PROG,
        description="Score a volume against a reference inside the reference's mask: PSNR, SSIM, NCC, RMSE "
        "after an affine fit of the intensities. Or, where there is no truth, by how well it predicts a stack that it "
        "was not made from (--held-out-stack), or each stack from the others (--leave-one-out).",
    )
    parser.add_argument("--volume", help="reconstructed volume (NIfTI)")
    parser.add_argument("--reference", help="true volume (NIfTI)")
    parser.add_argument("--mask", help="mask on the grid of the reference, or of the stack (NIfTI)")
    parser.add_argument("--align", action="store_true", help="remove one rigid motion of the whole head first")
    parser.add_argument(
        "--lpips-weights", metavar="PATH", help="also LPIPS: a folder with alexnet*.pth and alex.pth, or AlexNet's file"
    )
    parser.add_argument("--json", metavar="FILE", help="also write the scores here")
    parser.add_argument("--sections", metavar="FILE", help="also write a picture: reference, volume, error (PNG)")
    parser.add_argument("--poses", metavar="TSV", help="true slice poses (poses.tsv, with mask-N.nii.gz in its folder)")
    parser.add_argument("--slices", metavar="TSV", help="estimated slice poses (slices.tsv); with --poses")
    held_out.add_options(parser)
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code (0 done, 2 usage, 3 bad input, 4 out of memory, 130 interrupted)."""
    parser = build_parser()
    options = parsed(parser, argv)
    if (options.poses is None) != (options.slices is None):
        parser.error("--poses and --slices belong together")
    predicts = held_out.check_options(parser, options)
    logging.basicConfig(level=logging.WARNING, format=f"{PROG}: %(message)s")

    def work() -> int:
        record = held_out.run(options) if predicts else _scored(options)
        if options.json:
            _write_json(Path(options.json), record)
        return 0

    return run_command(PROG, work, interrupted=lambda: ("interrupted; no scores were written", INTERRUPTED))


def table(comparison: Comparison, pose_error: PoseError | None = None, lpips: float | None = None) -> str:
    """The scores as a few lines of text.

    Args:
        comparison: comparison of the volume with the truth.
        pose_error: pose error of the slices; None leaves it out.
        lpips: mean LPIPS distance of slices; None leaves it out.
    """
    s, alignment = comparison.scores, comparison.alignment
    lines = [
        f"{'PSNR dB':>8} {'SSIM':>7} {'NCC':>7} {'RMSE':>7}   voxels",
        f"{s.psnr_db:8.2f} {s.ssim:7.4f} {s.ncc:7.4f} {s.rmse:7.4f}   {s.n_voxels}",
    ]
    if lpips is not None:
        lines.append(f"LPIPS (AlexNet, v0.1): {lpips:.4f}")
    if alignment:
        lines.append(f"aligned: {alignment.rotation_deg:.2f} deg, {alignment.translation_mm:.2f} mm removed")
    if pose_error:
        lines.append(
            f"slice poses (TRE mm): mean {pose_error.mean_mm:.2f}, median {pose_error.median_mm:.2f}, "
            f"90th percentile {pose_error.p90_mm:.2f}; {pose_error.n_slices} slices, "
            f"{pose_error.n_missing} without an estimate"
        )
    return "\n".join(lines)


def _compare(options: argparse.Namespace) -> tuple[Comparison, float | None]:
    """Comparison of the volume with the reference, and their LPIPS if its weights are given."""
    from g3r.acquisition.images import load_mask, load_volume
    from g3r.evaluation.compare import compare

    volume, reference = load_volume(options.volume), load_volume(options.reference)
    mask = load_mask(options.mask, reference)
    lpips = None
    if options.lpips_weights:
        from g3r.evaluation.lpips import Lpips

        lpips = Lpips.load(options.lpips_weights)  # before the alignment, so that a wrong path fails at once
    comparison = compare(volume, reference, mask, align=options.align)
    if options.sections:
        from g3r.output.sections import save_sections

        rows = {
            "reference": reference.data,
            "volume": comparison.volume * mask,
            "error": abs(comparison.volume - reference.data) * mask,
        }
        save_sections(options.sections, rows, reference.affine, mask, maps=("error",))
    if lpips is None:
        return comparison, None
    data_range = comparison.scores.data_range
    return comparison, lpips.distance(comparison.volume / data_range, reference.data / data_range, mask)


def _pose_error(poses: str, slices: str) -> PoseError:
    from g3r.evaluation.pose_error import read_poses, slice_points, target_registration_error

    true, estimated = read_poses(poses), read_poses(slices)
    n_stacks = 1 + max(stack for stack, _ in true.keys)
    # lazily: a table may name a billionth stack, and the first missing mask ends the loop
    masks = (Path(poses).parent / f"mask-{n}.nii.gz" for n in range(n_stacks))
    return target_registration_error(slice_points(masks), true, estimated)


def _scored(options: argparse.Namespace) -> dict[str, Any]:
    """Compare with the truth, and print; returns the scores for --json."""
    from dataclasses import asdict

    comparison, lpips = _compare(options)
    pose_error = _pose_error(options.poses, options.slices) if options.poses else None
    print(table(comparison, pose_error, lpips))
    record: dict[str, Any] = asdict(comparison.scores)
    if lpips is not None:
        record["lpips"] = lpips
    if comparison.alignment:
        record["alignment"] = {
            "rotation_deg": comparison.alignment.rotation_deg,
            "translation_mm": comparison.alignment.translation_mm,
        }
    if pose_error:
        record["poses"] = pose_error.figures()
    return record


def _write_json(path: Path, record: dict[str, Any]) -> None:
    """Write the scores, whole or not at all."""
    from g3r.run.atomic_file import write_text

    try:
        write_text(path, json.dumps(record, indent=2) + "\n")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another file") from None


if __name__ == "__main__":
    sys.exit(main())
