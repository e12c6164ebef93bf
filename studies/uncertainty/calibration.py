"""`python -m studies.uncertainty.calibration fit` and `check`: the calibration of uncertainty.nii.gz."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g3r.bench.record import put_between_markers, write_json, write_text
from studies.command import parser_of, run_command

if TYPE_CHECKING:
    from studies.uncertainty.data import Judged

DEFAULT_FOLDER = Path("runs") / "bench" / "uncertainty"


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = parser_of(
        "uncertainty",
        "fit: fit the coefficients of uncertainty.nii.gz to simulated subjects of the validation atlas and "
        "write them into the package. check: compare stated uncertainty and error on subjects left out. "
        "Subjects and their registrations are kept in --cache. Needs the atlas in the folder that "
        "G3R_TEST_DATA names.",
        DEFAULT_FOLDER,
    )
    parser.add_argument("task", choices=("fit", "check"))
    parser.add_argument("--no-prior", action="store_true", help="for reconstructions without a prior")
    parser.add_argument("--subjects", type=int, metavar="N", help="the first N alone (None: all)")
    parser.add_argument("--cache", type=Path, default=DEFAULT_FOLDER / "subjects", help="simulated subjects")
    parser.add_argument("--figure", type=Path, metavar="PNG", help="also draw error against uncertainty (check)")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = build_parser().parse_args(argv)
    return run_command("uncertainty", _run, options)


def _run(options: argparse.Namespace) -> int:
    from g3r.bench.record import available_cores, use_threads
    from g3r.planning.presets import changed
    from g3r.reconstruct import GaussianReconstructor
    from studies.runs import preset_settings
    from studies.subjects import test_data_folder
    from studies.uncertainty.data import NO_REGISTRATION, check_recipes, fit_recipes, judged, unregistered_recipe

    atlas = test_data_folder() / "atlas"
    use_threads(options.threads or available_cores())
    settings = replace(preset_settings(options.preset), use_prior=not options.no_prior)
    reconstructor = GaussianReconstructor(options.ckpt, settings)
    fitting = options.task == "fit"
    chosen = (fit_recipes() if fitting else check_recipes())[: options.subjects]
    todo = [(*one, reconstructor) for one in chosen]
    if not fitting and not options.subjects:
        unregistered = GaussianReconstructor(options.ckpt, changed(settings, NO_REGISTRATION))
        todo.append((*unregistered_recipe(), unregistered))
    start, found = time.perf_counter(), []
    for spec, n_stacks, by in todo:
        one = judged(spec, n_stacks, by, atlas, options.cache, registered=by is reconstructor)
        found.append(one)
        print(
            f"{one.label}: {one.psnr_db:.2f} dB, poses {one.median_mm:.2f} mm, mean error "
            f"{100 * abs(one.error).mean():.2f} % of the brightest, {one.seconds:.0f} s "
            f"(map {one.map_seconds:.1f} s)",
            flush=True,
        )
    text = _fit(options, found) if fitting else _check(options, found)
    print(text)
    print(f"{time.perf_counter() - start:.0f} s")
    return 0


def _fit(options: argparse.Namespace, found: list[Judged]) -> str:
    """Fit the coefficients, every subject counting the same; write them into the package."""
    import numpy as np

    from g3r._version import __version__
    from g3r.uncertainty.error_model import fit_model, load_calibration, save_calibration, terms
    from g3r.uncertainty.estimate import CALIBRATION, WITH_PRIOR, WITHOUT_PRIOR

    of_each = [terms(one.predictors) for one in found]
    samples = {name: np.concatenate([one[name] for one in of_each]) for name in of_each[0]}
    error = np.concatenate([one.error for one in found])
    weight = np.concatenate([np.full(len(one.error), 1 / len(one.error)) for one in found])
    model = fit_model(samples, error, weight)
    name = WITHOUT_PRIOR if options.no_prior else WITH_PRIOR
    models, records = load_calibration(CALIBRATION) if CALIBRATION.is_file() else ({}, {})
    records[name] = {
        "g3r": __version__,
        "preset": options.preset,
        "prior": _weights(options),
        "voxels_per_subject": len(found[0].error),
        "subjects": [
            {"volume": r.volume, "motion": r.motion, "seed": r.seed, "stacks": one.n_stacks}
            for one in found
            for r in [one.spec]
        ],
    }
    save_calibration(CALIBRATION, {**models, name: model}, records)
    lines = [f"ln u = {model.intercept:.3f}", *(f"  + {b:.3f} {n}" for n, b in model.coefficients.items())]
    return "\n".join([f"{name}, written to {CALIBRATION.name}:", *lines])


def _check(options: argparse.Namespace, found: list[Judged]) -> str:
    """Judge the shipped coefficients; record, table and figure."""
    import json

    from g3r.uncertainty.estimate import WITH_PRIOR, WITHOUT_PRIOR, calibration
    from studies.uncertainty.judgement import check_record, check_text

    name = WITHOUT_PRIOR if options.no_prior else WITH_PRIOR
    path = options.output / "check.json"
    record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    record[name] = {"preset": options.preset, "weights": _weights(options), **check_record(found, calibration()[name])}
    write_json(path, record)
    text = check_text(record)
    write_text(options.output / "check.md", text)
    if options.docs:
        put_between_markers(options.docs, "uncertainty", text)
    if options.figure:
        from studies.uncertainty.figure import draw_calibration

        draw_calibration(record[name], options.figure)
    return text


def _weights(options: argparse.Namespace) -> str | None:
    """Which prior the figures belong to."""
    from g3r.checkpoints.weights_file import SHIPPED_PRIOR
    from studies.prior.volumes import file_digest

    return None if options.no_prior else file_digest(Path(options.ckpt or SHIPPED_PRIOR))


if __name__ == "__main__":
    sys.exit(main())
