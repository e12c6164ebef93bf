"""`python -m studies.motion.bias`: poses and volume under shading, with the shading estimated and not."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g3r.bench.record import markdown_table, put_between_markers, write_json, write_text
from studies.command import parser_of, run_command

if TYPE_CHECKING:
    from studies.subjects import SubjectSpec

BIASES = (0.05, 0.15)
VOLUMES = ("crl-sta/sta30", "spina-bifida/sb32-operated")
"""A week left out of training, and a volume that training used for choosing only."""

SEED = 33_000
"""Seeds from here on belong to this benchmark; a volume has the same at every strength of shading, so that
motion, noise and the shape of the shading agree."""

VARIANTS: dict[str, Mapping[str, Any]] = {"estimated": {}, "not estimated": {"slice_stage.optimise_bias_field": False}}
"""What is compared; options as `g3r.planning.presets.changed` reads them."""

DEFAULT_FOLDER = Path("runs") / "bench" / "motion-bias"


def specs(n_repeats: int = 1) -> list[SubjectSpec]:
    """The subjects: each volume with moderate motion, `n_repeats` times, at each strength of shading."""
    from studies.subjects import SubjectSpec

    return [
        SubjectSpec(
            name=f"bias-{bias:.2f}-{volume.rsplit('/', 1)[-1]}-{number}",
            volume=volume,
            motion="moderate",
            seed=SEED + n + len(VOLUMES) * number,
            bias=bias,
            stretch=0.0,
        )
        for n, volume in enumerate(VOLUMES)
        for number in range(n_repeats)
        for bias in BIASES
    ]


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = parser_of(
        "motion_bias",
        "Reconstruct subjects with weak and strong shading, with the shading estimated and not. "
        "Needs the atlas in the folder that G3R_TEST_DATA names.",
        DEFAULT_FOLDER,
    )
    parser.add_argument("--repeats", type=int, default=1, metavar="N", help="subjects of each volume")
    parser.add_argument("--motion-only", action="store_true", help="registration alone, no volume")
    parser.add_argument("--cache", type=Path, default=DEFAULT_FOLDER / "subjects", help="simulated subjects")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = build_parser().parse_args(argv)
    return run_command("motion_bias", _run, options)


def _run(options: argparse.Namespace) -> int:
    from g3r.bench.record import available_cores, machine, use_threads
    from g3r.evaluation.case import load_case
    from g3r.planning.presets import changed
    from studies.runs import preset_settings, reconstructed, registered
    from studies.subjects import simulated_subject, test_data_folder

    atlas, settings = test_data_folder() / "atlas", preset_settings(options.preset)
    threads = options.threads or available_cores()
    use_threads(threads)
    rows: list[dict[str, Any]] = []
    record = {"preset": options.preset, "threads": threads, "machine": machine(), "runs": rows}
    for spec in specs(options.repeats):
        case = load_case(simulated_subject(spec, atlas, options.cache))
        for variant, changes in VARIANTS.items():
            chosen = changed(settings, changes)
            if options.motion_only and chosen != settings and chosen.registration == settings.registration:
                continue  # registration would do the same again
            run = registered(case, chosen) if options.motion_only else reconstructed(case, chosen, options.ckpt)
            # without the fit, settings left as they are say nothing about the shading
            label = "-" if options.motion_only and not changes else variant
            row = {"volume": spec.volume, "seed": spec.seed, "bias": spec.bias, "shading": label}
            rows.append({**row, **run.record()})
            print(table(record).splitlines()[-1], flush=True)
            write_json(options.output / "bias.json", record)
    text = table(record)
    write_text(options.output / "bias.md", text)
    print(text)
    if options.docs:
        put_between_markers(options.docs, "bias", text)
    return 0


def table(record: Mapping[str, Any]) -> str:
    """A row per run in Markdown."""
    head = ["volume", "seed", "bias", "shading", "TRE median mm", "TRE p90 mm", "PSNR dB", "SSIM", "warned"]
    head += ["wall s"]
    rows = [
        [
            row["volume"],
            row["seed"],
            f"{row['bias']:.2f}",
            row["shading"],
            f"{row['median_mm']:.2f}",
            f"{row['p90_mm']:.2f}",
            _figure(row, "psnr_db", 2),
            _figure(row, "ssim", 3),
            "yes" if row["warned"] else "-",
            f"{row['seconds']:.0f}",
        ]
        for row in record["runs"]
    ]
    return f"Preset `{record['preset']}`, {record['threads']} threads.\n\n{markdown_table(head, rows)}"


def _figure(row: Mapping[str, Any], key: str, digits: int) -> str:
    return f"{row[key]:.{digits}f}" if key in row else ""


if __name__ == "__main__":
    sys.exit(main())
