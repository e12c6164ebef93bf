"""`python -m studies.uncertainty.calibration`: fit and check the calibration of uncertainty.nii.gz."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import asdict, replace

import numpy as np

from g3r._version import __version__
from g3r.planning.presets import PRESETS, changed
from g3r.reconstruct import GaussianReconstructor
from g3r.uncertainty.error_model import load_calibration, terms
from g3r.uncertainty.estimate import CALIBRATION, WITH_PRIOR, WITHOUT_PRIOR, calibration
from studies.harness import FITS, Record, Row, Study, Task, positive, weights
from studies.uncertainty.data import CHECK_SUBJECTS, FIT_SUBJECTS, NO_REGISTRATION, UNREGISTERED, Judged, judged
from studies.uncertainty.error_fit import fit_model, save_calibration
from studies.uncertainty.figure import draw_calibration
from studies.uncertainty.judgement import check_record, check_text


def model_name(options: argparse.Namespace) -> str:
    """Name of the set of coefficients: with or without prior."""
    return WITHOUT_PRIOR if options.no_prior else WITH_PRIOR


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task: the fit of the coefficients, or their check."""
    if options.task == "fit":
        yield Task(f"fit, {model_name(options)}", fit, (options,))
    else:
        yield Task(model_name(options), check, (options,))


def reconstructed(options: argparse.Namespace, *, fitting: bool) -> list[Judged]:
    """Predictors and errors of every subject, voxel by voxel; for the check also of one without registration."""
    settings = replace(PRESETS[options.preset], use_prior=not options.no_prior)
    reconstructor = GaussianReconstructor(options.ckpt, settings)
    subjects = (FIT_SUBJECTS if fitting else CHECK_SUBJECTS)[: options.subjects]
    todo = [(one, reconstructor) for one in subjects]
    if not fitting and not options.subjects:
        unregistered = GaussianReconstructor(options.ckpt, changed(settings, NO_REGISTRATION))
        todo.append((UNREGISTERED, unregistered))
    found = []
    for subject, by in todo:
        one = judged(subject, by, options.cache, registered=by is reconstructor)
        found.append(one)
        print(
            f"{one.label}: {one.psnr_db:.2f} dB, poses {one.median_mm:.2f} mm, mean error "
            f"{100 * abs(one.error).mean():.2f} % of the brightest, {one.seconds:.0f} s "
            f"(map {one.map_seconds:.1f} s)",
            flush=True,
        )
    return found


def fit(options: argparse.Namespace) -> Row:
    """Fit the coefficients with equal weight for every subject, and write them into the package."""
    found = reconstructed(options, fitting=True)
    of_each = [terms(one.predictors) for one in found]
    samples = {name: np.concatenate([one[name] for one in of_each]) for name in of_each[0]}
    error = np.concatenate([one.error for one in found])
    weight = np.concatenate([np.full(len(one.error), 1 / len(one.error)) for one in found])
    model = fit_model(samples, error, weight)
    name = model_name(options)
    models, records = load_calibration(CALIBRATION) if CALIBRATION.is_file() else ({}, {})
    records[name] = {
        "g3r": __version__,
        "preset": options.preset,
        "prior": _weights(options),
        "voxels_per_subject": len(found[0].error),
        "subjects": [
            {
                "volume": one.spec.volume,
                "motion": one.spec.motion,
                "seed": one.spec.seed,
                "stacks": one.n_stacks,
                "holes": [asdict(hole) for hole in one.holes],
            }
            for one in (judged.subject for judged in found)
        ],
    }
    save_calibration(CALIBRATION, {**models, name: model}, records)
    return {"intercept": model.intercept, "coefficients": model.coefficients}


def check(options: argparse.Namespace) -> Row:
    """Check the shipped coefficients on subjects to which they were not fitted."""
    found = reconstructed(options, fitting=False)
    judgement = check_record(found, calibration()[model_name(options)])
    return {"preset": options.preset, "weights": _weights(options), **judgement}


def line(key: str, row: Row) -> str:
    """Progress line with the coefficients."""
    parts = [f"ln u = {row['intercept']:.3f}", *(f"  + {b:.3f} {name}" for name, b in row["coefficients"].items())]
    written = f", written to {CALIBRATION.name}" if key.startswith("fit") else ""
    return "\n".join([f"{key}{written}:", *parts])


def checked(record: Record) -> dict[str, Row]:
    """The checks in the record, with and without prior."""
    return {name: record["rows"][name] for name in (WITH_PRIOR, WITHOUT_PRIOR) if name in record["rows"]}


def tables(record: Record) -> dict[str, str]:
    """The tables of the check, if there was one."""
    found = checked(record)
    return {"uncertainty": check_text(found)} if found else {}


def draw(record: Record, options: argparse.Namespace) -> None:
    """Draw error against uncertainty of the check."""
    if options.task == "check":
        draw_calibration(record["rows"][model_name(options)], options.figure)


def _weights(options: argparse.Namespace) -> str | None:
    """The weights of the prior that was used, if any."""
    return None if options.no_prior else weights(options.ckpt)


STUDY = Study(
    name="uncertainty.calibration",
    about="fit: fit the coefficients of uncertainty.nii.gz to simulated subjects of the validation atlas and "
    "write them into the package. check: compare stated uncertainty and error on other subjects. "
    "Subjects and their registrations are kept in --cache.",
    document="prior.md",
    picture="uncertainty-calibration.png",
    shared=(*FITS, "--cache"),
    options={
        "task": {"choices": ("fit", "check")},
        "--no-prior": {"action": "store_true", "help": "for reconstructions without a prior"},
        "--subjects": {"type": positive, "metavar": "N", "help": "the first N alone (None: all)"},
    },
    tasks=tasks,
    line=line,
    tables=tables,
    figure=draw,
    resumes=False,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
