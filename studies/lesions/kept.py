"""`python -m studies.lesions.kept`: does a lesion that slices cover survive the prior?"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import mean, stdev
from typing import TYPE_CHECKING, Any

from g3r.bench.record import markdown_table, put_between_markers, write_json, write_text
from g3r.errors import InputError
from studies.command import parser_of, run_command

if TYPE_CHECKING:
    from studies.lesions.runs import LesionRun

VOLUMES = ("crl-sta/sta24", "crl-sta/sta30", "crl-sta/sta34")
"""Weeks that no training and no choice has seen."""

DEVELOPMENT_VOLUMES = ("spina-bifida/sb26-operated", "spina-bifida/sb30-operated", "spina-bifida/sb33-operated")

FIRST_SEED, DEVELOPMENT_SEED = 52_300, 51_300

STACK_NUMBERS = (3, 1)
WANTED_SHARE = 0.85
"""Of what the fit without prior keeps."""

WITH_PRIOR, WITHOUT_PRIOR, PRIOR_ALONE = "with prior", "without prior", "prior alone"
VARIANTS = (WITHOUT_PRIOR, WITH_PRIOR, PRIOR_ALONE)
KINDS = ("bright", "dark", "ventricle")

DEFAULT_FOLDER = Path("runs") / "bench" / "lesions"


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = parser_of(
        "lesions",
        "Put bright and dark spheres of 6 mm and an enlarged ventricle into heads that no training has seen, "
        "slice them, reconstruct with and without prior, and measure how much of each lesion is kept. "
        "Needs the atlas in the folder that G3R_TEST_DATA names.",
        DEFAULT_FOLDER,
    )
    parser.add_argument("--subjects", type=int, default=3, metavar="N", help="heads, week after week")
    parser.add_argument("--stacks", nargs="+", type=int, choices=STACK_NUMBERS, default=list(STACK_NUMBERS))
    parser.add_argument("--development", action="store_true", help="another atlas, seeds that may be looked at")
    parser.add_argument("--figure", type=Path, metavar="PNG", help="also draw sections of the first head")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = build_parser()
    options = parser.parse_args(argv)
    if options.subjects < 1:
        parser.error(f"--subjects {options.subjects}; expected at least 1")
    return run_command("lesions", _run, options)


def _run(options: argparse.Namespace) -> int:
    from g3r.bench.record import available_cores, machine, use_threads
    from g3r.checkpoints.weights_file import SHIPPED_PRIOR
    from g3r.reconstruct import GaussianReconstructor
    from studies.lesions.runs import lesion_run, lesion_subject
    from studies.prior.volumes import file_digest
    from studies.runs import preset_settings
    from studies.subjects import test_data_folder

    if options.docs and options.development:
        raise InputError("--docs: the published table needs seeds not looked at; leave out --development")
    atlas = test_data_folder() / "atlas"
    use_threads(options.threads or available_cores())
    settings = preset_settings(options.preset)
    # at the true poses no slice may move, or the two reconstructions of a pair would differ by that too
    settings = replace(
        settings,
        registration=replace(settings.registration, segments=False),
        slice_stage=replace(settings.slice_stage, optimise_poses=False),
    )
    reconstructors = {
        WITHOUT_PRIOR: GaussianReconstructor(None, replace(settings, use_prior=False)),
        WITH_PRIOR: GaussianReconstructor(options.ckpt, settings),
    }
    volumes = DEVELOPMENT_VOLUMES if options.development else VOLUMES
    first_seed = DEVELOPMENT_SEED if options.development else FIRST_SEED
    start = time.perf_counter()
    record: dict[str, Any] = {
        "preset": options.preset,
        "weights": file_digest(Path(options.ckpt or SHIPPED_PRIOR)),
        "machine": machine(),
        "rows": [],
    }
    shown: list[LesionRun] = []
    for n in range(options.subjects):
        subject = lesion_subject(volumes[n % len(volumes)], first_seed + n, atlas)
        for n_stacks in options.stacks:
            run = lesion_run(subject, n_stacks, reconstructors, PRIOR_ALONE)
            record["rows"] += run.rows()
            print(f"{subject.name}, {n_stacks} stacks: {run.line()}, {run.seconds:.0f} s", flush=True)
            if n == 0:
                shown.append(run)
        write_json(options.output / "lesions.json", record)
    record["seconds"] = round(time.perf_counter() - start, 1)
    write_json(options.output / "lesions.json", record)
    text = lesion_text(record)
    write_text(options.output / "lesions.md", text)
    print(text)
    print(f"{record['seconds']:.0f} s")
    if options.docs:
        put_between_markers(options.docs, "lesions", text)
    if options.figure:
        from studies.lesions.figure import draw_lesions_kept

        draw_lesions_kept(shown, VARIANTS, options.figure)
    return 0


def lesion_text(record: dict[str, Any]) -> str:
    """The tables in Markdown: by kind and number of stacks, then every lesion."""
    rows: list[dict[str, Any]] = record["rows"]
    head = ["lesion", "stacks", "lesions", *VARIANTS, "with / without prior", "smallest", "wanted"]
    summary = []
    for n in sorted({row["n_stacks"] for row in rows}, reverse=True):
        for kind in KINDS:
            of_kind = [row for row in rows if row["kind"] == kind and row["n_stacks"] == n]
            if not of_kind:
                continue
            ratios = [row["kept"][WITH_PRIOR] / row["kept"][WITHOUT_PRIOR] for row in of_kind]
            shares = [_spread([row["kept"][variant] for row in of_kind]) for variant in VARIANTS]
            summary.append(
                [_NAMES[kind], n, len(of_kind), *shares, _spread(ratios), f"{min(ratios):.2f}", f"{WANTED_SHARE:.2f}"]
            )
    each = [
        [row["subject"], row["n_stacks"], row["kind"], *(f"{row['kept'][v]:.2f}" for v in VARIANTS)] for row in rows
    ]
    lines = [
        f"Preset `{record['preset']}`, weights {record['weights']}. Share of the true contrast that is kept "
        "(1: all, 0: the lesion is not there), mean ± standard deviation over lesions; then the ratio that "
        f"is wanted to be at least {WANTED_SHARE:.2f}.",
        "",
        markdown_table(head, summary),
        "",
        "<details><summary>Every lesion</summary>",
        "",
        markdown_table(["subject", "stacks", "lesion", *VARIANTS], each),
        "",
        "</details>",
    ]
    return "\n".join(lines)


_NAMES = {"bright": "bright sphere, 6 mm", "dark": "dark sphere, 6 mm", "ventricle": "enlarged ventricle"}


def _spread(values: Sequence[float]) -> str:
    return f"{mean(values):.2f} ± {stdev(values) if len(values) > 1 else 0:.2f}"


if __name__ == "__main__":
    sys.exit(main())
