"""Short trainings of variants of the prior network, each in its own process, with the same settings otherwise."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from studies.prior.network_scores import LEFT_OUT, VALIDATED_ON
from studies.subjects import REPOSITORY

CONFIG = REPOSITORY / "lightning_configs" / "prior.yaml"


@dataclass(frozen=True)
class Variant:
    """A network to be trained.

    Args:
        name: of its folder, and in tables.
        what: how it differs, in words.
        options: of the network, in addition to the configuration.
        is_size: whether it belongs to the curve of error against seconds.
    """

    name: str
    what: str
    options: Mapping[str, Any] = field(default_factory=dict)
    is_size: bool = False


def configuration() -> dict[str, Any]:
    """The configuration of the training from which the variants differ."""
    return dict(yaml.safe_load(CONFIG.read_text(encoding="utf-8")))


def epochs_of(steps: int, config: Mapping[str, Any], arguments: Sequence[str] = ()) -> int:
    """Whole epochs nearest to a number of optimiser steps, at least one.

    Args:
        steps: of the optimiser.
        config: of the training.
        arguments: further arguments, which may change the size of an epoch, such as `--data.batch_size=2`.
    """
    data = dict(config["data"]["init_args"])
    for argument in arguments:
        name, _, value = argument.removeprefix("--data.").partition("=")
        if name in data and value.isdecimal():
            data[name] = int(value)
    per_epoch = data["subjects_per_epoch"] * data["patches_per_subject"] // data["batch_size"]
    return max(1, round(steps / per_epoch))


def data_arguments(source: Path, cache: Path, val_subjects: int) -> list[str]:
    """Arguments about the data, the same for all variants."""
    listed = {"exclude": LEFT_OUT, "val_include": VALIDATED_ON}
    return [
        f"--data.source={source}",
        f"--data.cache={cache}",
        f"--data.val_subjects={val_subjects}",
        *(f"--data.{name}={json.dumps(patterns)}" for name, patterns in listed.items()),
    ]


def train(
    variant: Variant, run: Path, n_epochs: int, arguments: Sequence[str], *, fresh: bool
) -> tuple[Path | None, float]:
    """Train a variant in a process of its own, going on where an earlier one stopped unless `fresh`.

    Returns:
        Its last checkpoint, or None if the training failed (`train.log` holds the reason), and wall seconds.
    """
    if fresh:  # an earlier training may be finished, and of other code
        shutil.rmtree(run, ignore_errors=True)
    run.mkdir(parents=True, exist_ok=True)
    last = newest_checkpoint(run)
    command = [
        *(sys.executable, "-m", "g3r.cli.pretrain", "fit", "--config", str(CONFIG), *arguments),
        *(f"--model.network.{name}={json.dumps(value)}" for name, value in variant.options.items()),
        f"--trainer.max_epochs={n_epochs}",
        "--trainer.max_time=null",
        "--trainer.enable_progress_bar=false",
        f"--trainer.logger.init_args.save_dir={run}",
        "--trainer.logger.init_args.name=logs",
        *([f"--ckpt_path={last}"] if last else []),
    ]
    print(f"{variant.name}: {'going on' if last else 'training'}, {n_epochs} epochs", flush=True)
    start = time.perf_counter()
    with (run / "train.log").open("ab") as log:
        done = subprocess.run(command, cwd=REPOSITORY, stdout=log, stderr=log, check=False)
    seconds = time.perf_counter() - start
    return (newest_checkpoint(run) if done.returncode == 0 else None), seconds


def newest_checkpoint(run: Path) -> Path | None:
    """The last checkpoint of the last process that trained in a folder."""
    found = sorted(run.glob("logs/version_*/checkpoints/last*.ckpt"), key=lambda path: path.stat().st_mtime)
    return found[-1] if found else None
