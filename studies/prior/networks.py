"""`python -m studies.prior.networks`: comparison of variants of the prior network after the same training."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from g3r.bench.record import machine
from g3r.errors import InputError
from g3r.prior.config import PriorNetworkConfig
from g3r.run.machine import available_cores
from studies.harness import Record, Row, Study, Task, positive
from studies.prior.figures import draw_networks
from studies.prior.network_scores import (
    BASELINES,
    EXPORTED,
    SPEED_SHAPE,
    evaluate,
    inference_seconds,
    scores_by_stacks,
    validation_volumes,
)
from studies.prior.trainings import CONFIG, Variant, configuration, data_arguments, epochs_of, train
from studies.subjects import data_folder
from studies.tables import Cell, stacks, table

VARIANTS = (
    Variant("full", "the configuration as it is", is_size=True),
    Variant("alpha-0.05", "the paper's gate", {"alpha": 0.05}),
    Variant("no-sharp", "F does not see V_sharp", {"use_sharp": False}),
    Variant("no-template", "no template under the residual", {"use_template": False}),
    Variant("sharp-base", "the residual is added to V_sharp", {"sharp_base": True}),
    Variant(
        "as-printed",
        "Eq. 7 as printed, alpha 0.05",
        {"use_sharp": False, "sharp_base": False, "use_template": False, "alpha": 0.05},
    ),
    Variant("size-16-32-64", "channels 16, 32, 64", {"channels": [16, 32, 64]}, is_size=True),
    Variant("size-32-64-96", "channels 32, 64, 96", {"channels": [32, 64, 96]}, is_size=True),
    Variant("size-48-96-128", "channels 48, 96, 128", {"channels": [48, 96, 128]}, is_size=True),
)
NAMES = tuple(variant.name for variant in VARIANTS)


def settings(options: argparse.Namespace) -> Record:
    """Common settings of all variants; a later table reads them from the record."""
    if options.no_train:
        return {}
    epochs = epochs_of(options.steps, configuration(), options.train_args)
    return {"epochs": epochs, "arguments": options.train_args}


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """Tasks for the inputs of the network and for the variants."""
    if options.no_train:
        return
    config = configuration()
    source = options.source or data_folder("atlas")
    data = (source, options.cache, options.val_subjects)
    for name in BASELINES:
        yield Task(name, baseline, (name, data))
    n_epochs = epochs_of(options.steps, config, options.train_args)
    for variant in distinct_variants(config):
        if variant.name in options.only:
            yield Task(variant.name, measure, (variant, n_epochs, data, options))


def baseline(name: str, data: tuple[Path, Path, int]) -> Row:
    """Scores of one input volume of the network."""
    volumes = validation_volumes(*data, CONFIG)
    return {"scores": scores_by_stacks([one[BASELINES[name]] for one in volumes], volumes)}


def measure(variant: Variant, n_epochs: int, data: tuple[Path, Path, int], options: argparse.Namespace) -> Row | None:
    """Train and score one variant.

    Args:
        variant: to train.
        n_epochs: of training.
        data: the first three arguments of `validation_volumes`.
        options: of the command.

    Returns:
        The row of the record, or None when training failed.
    """
    run = options.output / variant.name
    checkpoint, seconds = train(
        variant, run, n_epochs, [*data_arguments(*data), *options.train_args], fresh=options.fresh
    )
    if checkpoint is None:
        print(f"{variant.name}: training failed; see {run / 'train.log'}", file=sys.stderr)
        return None
    return {
        "what": variant.what,
        "options": dict(variant.options),
        "is_size": variant.is_size,
        "train_seconds": round(seconds),
        **evaluate(checkpoint, run, validation_volumes(*data, CONFIG)),
    }


def finish(record: Record, options: argparse.Namespace) -> None:
    """Measure the seconds of all variants again, if requested."""
    if options.retime:
        record |= {"threads": options.threads or available_cores(), "machine": machine()}
        for name, row in record["rows"].items():
            if "seconds" in row:
                row["seconds"] = inference_seconds(options.output / name / EXPORTED)


def distinct_variants(config: Mapping[str, Any]) -> list[Variant]:
    """The variants, without one whose size equals that of the configuration."""
    network = config["model"]["init_args"]["network"]
    model = {**asdict(PriorNetworkConfig()), **network}
    return [
        variant
        for variant in VARIANTS
        if not variant.options or any(model.get(name) != value for name, value in variant.options.items())
    ]


def tables(record: Record) -> dict[str, str]:
    """A row per variant, after rows for the inputs of the network.

    Raises:
        InputError: no variant has been trained.
    """
    ordered = [{"name": name, **record["rows"][name]} for name in (*BASELINES, *NAMES) if name in record["rows"]]
    if not any("what" in row for row in ordered):
        raise InputError("the record holds no trained variant; leave out --no-train")
    numbers = sorted({n for row in ordered for n in row["scores"] if n != "all"})
    columns: dict[str, Cell] = {
        "": "{name}",
        "differs by": "{what}",
        "L1": "{scores[all][l1]:.4f}",
        **{f"{stacks(int(n))}, dB": _psnr(n) for n in numbers},
        "all, dB": "{scores[all][psnr_db]:.2f}",
        "SSIM": "{scores[all][ssim]:.3f}",
        "weights": lambda row: f"{row['parameters'] / 1e6:.2f} M" if "parameters" in row else "",
        "s per brain": "{seconds:.1f}",
        "steps": "{steps}",
        "trained, min": lambda row: f"{row['train_seconds'] / 60:.0f}" if "train_seconds" in row else "",
    }
    size = " x ".join(map(str, SPEED_SHAPE))
    head = (
        "Mean over the validation volumes, in the mask, in normalised intensities (PSNR: range 1); "
        f"seconds for one view of {size} voxels on {record['threads']} threads. Trained with "
        f"`{' '.join(record.get('arguments', [])) or 'the configuration as it is'}`."
    )
    return {"networks": f"{head}\n\n{table(ordered, columns)}"}


def _psnr(n: str) -> Cell:
    # not a format, which reads a number in brackets as a list index
    return lambda row: f"{row['scores'][n]['psnr_db']:.2f}" if n in row["scores"] else ""


STUDY = Study(
    name="prior.networks",
    about="Train variants of the prior network for the same number of steps on the same subjects and seed, and "
    "compare them on the validation volumes. Interrupted trainings go on where they stopped.",
    document="prior.md",
    picture="prior-networks.png",
    shared=("--threads", "--cache"),
    options={
        "--steps": {"type": positive, "default": 384, "metavar": "N", "help": "of the optimiser, to whole epochs"},
        "--only": {"nargs": "+", "choices": NAMES, "metavar": "NAME", "default": NAMES, "help": "of the variants"},
        "--source": {"type": Path, "help": "atlas folder (None: the one of the test data)"},
        "--val-subjects": {"type": positive, "default": 9, "metavar": "N", "help": "volumes to compare on"},
        "--no-train": {"action": "store_true", "help": "only the table and the figure"},
        "--retime": {"action": "store_true", "help": "measure all seconds again, on a quiet machine"},
        "train_args": {"nargs": "*", "metavar": "-- ARG", "help": "more of g3r-pretrain: --data.batch_size=2"},
    },
    settings=settings,
    tasks=tasks,
    finish=finish,
    tables=tables,
    figure=lambda record, options: draw_networks(record, options.figure),
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
