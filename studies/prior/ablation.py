"""`python -m studies.prior.ablation`: what the prior brings to the fit, by the number of stacks."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from statistics import mean, stdev
from typing import TYPE_CHECKING, Any

from g3r.bench.record import markdown_table, put_between_markers, write_json, write_text
from g3r.errors import InputError
from studies.command import parser_of, run_command

if TYPE_CHECKING:
    from g3r.evaluation.case import SimulatedCase
    from g3r.planning.presets import ReconstructionSettings
    from studies.subjects import SubjectSpec

VOLUMES = (
    "crl-sta/sta24",
    "crl-sta/sta30",
    "crl-sta/sta34",
    "spina-bifida/sb25-operated",
    "spina-bifida/sb27-operated",
    "spina-bifida/sb29-operated",
    "spina-bifida/sb31-operated",
    "spina-bifida/sb33-operated",
)
"""None was trained on. Weeks 24, 30 and 34 were used for nothing at all, but their neighbours were trained
on; the operated volumes are another atlas, whose volumes before operation were trained on, and checkpoints
were chosen by operated ones."""

GROUPS = {"sta": "crl-sta/", "sb": "spina-bifida/"}

FIRST_SEED, DEVELOPMENT_SEED = 52_000, 51_000
"""Seeds from the first belong to the published table; from the second they may be looked at before."""

MOTION = "mild"
STACK_NUMBERS = (1, 2, 3)

BASELINE = "fit without prior"

FITS: dict[str, Mapping[str, Any]] = {
    BASELINE: {"use_prior": False},
    "prior as initialisation": {"distillation": False},
    "with distillation": {},
}
"""What is fitted, as changes of the settings (see `g3r.planning.presets.changed`); the last is the product."""

VARIANTS = ("V_coarse", "V_sharp", "prior alone", *FITS)
"""In the order of the table."""

DEFAULT_FOLDER = Path("runs") / "bench" / "prior-ablation"


def specs(*, development: bool = False) -> list[SubjectSpec]:
    """The subjects; always the same."""
    from studies.subjects import SubjectSpec

    first = DEVELOPMENT_SEED if development else FIRST_SEED
    return [
        SubjectSpec(f"{MOTION}-{first + n}-{volume.rsplit('/', 1)[-1]}", volume, MOTION, first + n)
        for n, volume in enumerate(VOLUMES)
    ]


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = parser_of(
        "prior_ablation",
        "Reconstruct subjects that no training has seen from one, two and three stacks, without prior, "
        "with the prior as the start, and with distillation. What the record holds already, made with the "
        "same weights and settings, is kept. Needs the atlas in the folder that G3R_TEST_DATA names.",
        DEFAULT_FOLDER,
    )
    parser.add_argument("--subjects", nargs="+", metavar="WORD", default=[""], help="names that contain one")
    parser.add_argument("--stacks", nargs="+", type=int, choices=STACK_NUMBERS, default=list(STACK_NUMBERS))
    parser.add_argument("--development", action="store_true", help="seeds that may be looked at")
    parser.add_argument("--fresh", action="store_true", help="keep nothing of an earlier record")
    parser.add_argument("--cache", type=Path, default=DEFAULT_FOLDER / "subjects", help="simulated subjects")
    parser.add_argument("--jobs", type=int, default=1, help="subjects at the same time")
    parser.add_argument("--figure", type=Path, metavar="PNG", help="also draw dB by number of stacks")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = build_parser()
    options = parser.parse_args(argv)
    if options.jobs < 1:
        parser.error(f"--jobs {options.jobs}; expected at least 1")
    return run_command("prior_ablation", _run, options)


def _run(options: argparse.Namespace) -> int:
    from g3r.bench.record import available_cores, machine
    from g3r.checkpoints.weights_file import SHIPPED_PRIOR
    from studies.prior.volumes import file_digest
    from studies.runs import preset_settings
    from studies.subjects import test_data_folder

    if options.docs and options.development:
        raise InputError("--docs: the published table needs seeds not looked at; leave out --development")
    atlas = test_data_folder() / "atlas"
    settings = preset_settings(options.preset)
    every = specs(development=options.development)
    chosen = [r for r in every if any(word in r.name for word in options.subjects)]
    threads = options.threads or max(1, available_cores() // options.jobs)
    path = options.output / "ablation.json"
    record: dict[str, Any] = {
        "preset": options.preset,
        "weights": file_digest(Path(options.ckpt or SHIPPED_PRIOR)),
        "jobs": options.jobs,
        "threads": threads,
        "machine": machine(),
        "subjects": {},
    }
    rows = record["subjects"] if options.fresh else _kept(path, record)
    todo = [
        (spec, n)
        for n in sorted(options.stacks, reverse=True)  # the longest first, so that workers end together
        for spec in chosen
        if str(n) not in rows.get(spec.name, {})
    ]
    start = time.perf_counter()
    if todo:
        # a fresh interpreter for each worker: thread pools do not survive a fork
        with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
            waiting = {
                pool.submit(_one, *task, atlas, options.cache, settings, options.ckpt, threads): task for task in todo
            }
            for done in as_completed(waiting):
                spec, n_stacks = waiting[done]
                rows.setdefault(spec.name, {})[str(n_stacks)] = done.result()
                print(_line(spec.name, n_stacks, done.result()), flush=True)
                write_json(path, record)
    print(f"{len(todo)} of {len(chosen) * len(options.stacks)} made, {time.perf_counter() - start:.0f} s")
    text = ablation_tables(record)
    write_text(options.output / "ablation.md", text)
    print(text)
    if options.docs:
        put_between_markers(options.docs, "ablation", text)
    if options.figure:
        from studies.prior.figures import draw_ablation

        draw_ablation(rows, VARIANTS, BASELINE, options.figure)
    return 0


def _kept(path: Path, record: dict[str, Any]) -> dict[str, Any]:
    """The rows of an earlier record with the same preset and weights, put into this one."""
    if path.is_file():
        found = json.loads(path.read_text(encoding="utf-8"))
        if all(found.get(key) == record[key] for key in ("preset", "weights")):
            record["subjects"] = found["subjects"]
        else:
            print(f"{path}: made with other weights or settings, not kept")
    rows: dict[str, Any] = record["subjects"]
    return rows


def _one(
    spec: SubjectSpec,
    n_stacks: int,
    atlas: Path,
    cache: Path,
    settings: ReconstructionSettings,
    ckpt: str | None,
    threads: int,
) -> dict[str, Any]:
    """One subject from its first stacks, in a worker process."""
    from g3r.bench.record import use_threads
    from g3r.evaluation.case import load_case
    from studies.subjects import simulated_subject

    use_threads(threads)
    case = load_case(simulated_subject(spec, atlas, cache))
    case = replace(case, stacks=case.stacks[:n_stacks])
    return {"volume": spec.volume, **measure(case, settings, ckpt)}


def measure(case: SimulatedCase, settings: ReconstructionSettings, ckpt: str | None) -> dict[str, Any]:
    """Scores of every variant of one subject, after one registration that all of them share."""
    from g3r.planning.presets import changed
    from g3r.reconstruct import GaussianReconstructor
    from studies.prior.volumes import aligned_scores, figures

    start = time.perf_counter()
    motion = GaussianReconstructor(ckpt, settings).register_stacks(case.stacks)
    seconds = {"registration": round(time.perf_counter() - start, 2)}
    scores: dict[str, dict[str, float]] = {}
    tre: dict[str, float] = {}
    for name, options in FITS.items():
        start = time.perf_counter()
        result = GaussianReconstructor(ckpt, changed(settings, options)).reconstruct(case.stacks, motion)
        seconds[name] = round(time.perf_counter() - start, 2)
        error = case.pose_error(result.slices)
        tre[name] = error.median_mm

        def judged(volume: Any, grid: Any, near: Any = error.common) -> dict[str, float]:
            return figures(aligned_scores(volume, grid, case, near))

        scores[name] = judged(result.volume, result.grid)
        if name == BASELINE:
            scores["V_coarse"] = judged(result.coarse, result.prior_grid)
            scores["V_sharp"] = judged(result.prior, result.prior_grid)  # what stands in for a prior
    scores["prior alone"] = judged(result.prior, result.prior_grid)
    return {"scores": {name: scores[name] for name in VARIANTS}, "median_mm": tre, "seconds": seconds}


def _line(name: str, n_stacks: int, row: Mapping[str, Any]) -> str:
    listed = ", ".join(f"{variant} {row['scores'][variant]['psnr_db']:.2f}" for variant in VARIANTS)
    return f"{name}, {n_stacks} stacks: {listed} dB, {sum(row['seconds'].values()):.0f} s"


def ablation_tables(record: Mapping[str, Any]) -> str:
    """Mean and spread of each variant for all subjects and by atlas; then every subject."""
    rows: Mapping[str, Any] = record["subjects"]
    numbers = [n for n in STACK_NUMBERS if any(str(n) in of for of in rows.values())]
    head = ["variant"]
    for n in numbers:
        head += [f"{_stacks(n)}: dB", "SSIM", "to without prior, dB"]
    summary = [[name, *_cells(rows, name, numbers)] for name in VARIANTS]
    by_group = [
        [f"{name}, {group}", *_cells(_of_group(rows, group), name, numbers)]
        for group in GROUPS
        for name in (BASELINE, VARIANTS[-1])
        if _of_group(rows, group)
    ]
    each = [
        [
            name,
            n,
            *(f"{of[str(n)]['scores'][v]['psnr_db']:.2f}" for v in VARIANTS),
            f"{of[str(n)]['median_mm'][VARIANTS[-1]]:.2f}",
        ]
        for name, of in sorted(rows.items())
        for n in numbers
        if str(n) in of
    ]
    counts = ", ".join(f"{len(_of_group(rows, group))} {group}" for group in GROUPS)
    lines = [
        f"{len(rows)} subjects ({counts}), {MOTION} motion, preset `{record['preset']}`, weights "
        f"{record['weights']}. Mean and standard deviation over subjects; the last column of each number of "
        "stacks is the paired difference.",
        "",
        markdown_table(head, summary),
        "",
        "By atlas:",
        "",
        markdown_table(head, by_group),
        "",
        _worst(rows, numbers),
        "",
        "<details><summary>Every subject: dB, and median TRE in mm of the last variant</summary>",
        "",
        markdown_table(["subject", "stacks", *VARIANTS, "TRE"], each),
        "",
        "</details>",
    ]
    return "\n".join(lines)


def differences_db(rows: Mapping[str, Any], variant: str, n_stacks: int) -> list[float]:
    """By how much a variant is better than the fit without prior, subject by subject."""
    found = [of[str(n_stacks)]["scores"] for of in rows.values() if str(n_stacks) in of]
    return [scores[variant]["psnr_db"] - scores[BASELINE]["psnr_db"] for scores in found]


def values(rows: Mapping[str, Any], variant: str, n_stacks: int, key: str) -> list[float]:
    """One score of a variant, subject by subject."""
    return [of[str(n_stacks)]["scores"][variant][key] for of in rows.values() if str(n_stacks) in of]


def _cells(rows: Mapping[str, Any], variant: str, numbers: Sequence[int]) -> list[str]:
    cells = []
    for n in numbers:
        cells.append(_spread(values(rows, variant, n, "psnr_db"), "{:.2f}"))
        cells.append(_spread(values(rows, variant, n, "ssim"), "{:.3f}"))
        cells.append("" if variant == BASELINE else _spread(differences_db(rows, variant, n), "{:+.2f}"))
    return cells


def _spread(found: Sequence[float], form: str) -> str:
    if not found:
        return "-"
    deviation = f" ± {form.replace('+', '').format(stdev(found))}" if len(found) > 1 else ""
    return form.format(mean(found)) + deviation


def _worst(rows: Mapping[str, Any], numbers: Sequence[int]) -> str:
    least = []
    for n in numbers:
        found = differences_db(rows, VARIANTS[-1], n)
        better = sum(value > 0 for value in found)
        least.append(f"{_stacks(n)}: {min(found):+.2f} dB ({better} of {len(found)} better)")
    return f"The least that the prior with distillation brings to any subject: {'; '.join(least)}."


def _of_group(rows: Mapping[str, Any], group: str) -> dict[str, Any]:
    prefix = GROUPS[group]
    return {name: of for name, of in rows.items() if any(one["volume"].startswith(prefix) for one in of.values())}


def _stacks(n: int) -> str:
    return "1 stack" if n == 1 else f"{n} stacks"


if __name__ == "__main__":
    sys.exit(main())
