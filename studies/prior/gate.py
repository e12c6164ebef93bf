"""`python -m studies.prior.gate`: value of the density for the prior network, as an input and in the gate."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from math import log10
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

from g3r.errors import InputError
from studies.harness import Record, Row, Study, Task, positive
from studies.prior.network_scores import BASELINES, validation_volumes
from studies.prior.trainings import CONFIG, Variant, configuration, data_arguments, epochs_of, train
from studies.subjects import data_folder
from studies.tables import Cell, spread, table

if TYPE_CHECKING:
    from torch import Tensor

SEEDS = (1, 2, 3)
KINDS = {"coverage": "whole slices", "masked": "masked pixels", "printed": "as printed, 1/mm"}
"""Definitions of M_rho in words, by their names in `g3r.training.prior_batches.DENSITY_KINDS`."""


def variants() -> list[tuple[str, Variant]]:
    """The factorial design of density kind and network; without density in F and gate there is only one kind."""
    found = []
    for kind in KINDS:
        for in_f, gated in ((True, True), (True, False), (False, True)):
            options = {"use_density": in_f, "use_gate": gated}
            found.append((kind, Variant(f"{kind}{', in F' * in_f}{', gate' * gated}", KINDS[kind], options)))
    neither = Variant("neither", "", {"use_density": False, "use_gate": False})
    return [*found, (next(iter(KINDS)), neither)]


def settings(options: argparse.Namespace) -> Record:
    """Settings that all variants share."""
    epochs = epochs_of(options.steps, configuration(), options.train_args)
    return {"epochs": epochs, "arguments": options.train_args, "val_subjects": options.val_subjects}


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """Tasks for the baselines and for every variant with every seed, one seed after the other.

    An interrupted study then has all variants for its first seeds.
    """
    data = (options.source or data_folder("atlas"), options.cache, options.val_subjects)
    for name in (*BASELINES, "base"):
        yield Task(name, baseline, (name, data))
    for seed in options.seeds:
        for kind, variant in variants():
            yield Task(f"{variant.name}, seed {seed}", measure, (kind, variant, seed, data, options))


def baseline(name: str, data: tuple[Path, Path, int]) -> Row:
    """Scores of one input volume of the network.

    Args:
        name: of `BASELINES`, or "base" for the volume to which the residual is added.
        data: the first three arguments of `validation_volumes`.
    """
    from g3r.prior.config import PriorNetworkConfig
    from g3r.training.prior_batches import prior_inputs

    volumes = validation_volumes(*data, CONFIG)
    config = PriorNetworkConfig()
    made = [prior_inputs(one).base(config) if name == "base" else one[BASELINES[name]] for one in volumes]
    return {"variant": name, "scores": scores(made, volumes)}


def measure(
    kind: str, variant: Variant, seed: int, data: tuple[Path, Path, int], options: argparse.Namespace
) -> Row | None:
    """Train and score one variant; None if the training failed.

    Args:
        kind: of the density.
        variant: of the network.
        seed: of its weights and of the random symmetry operations on patches.
        data: the first three arguments of `validation_volumes`.
        options: of the command.
    """
    run = options.output / variant.name.replace(", ", "-").replace(" ", "-") / f"seed-{seed}"
    n_epochs = epochs_of(options.steps, configuration(), options.train_args)
    own = [f"--model.density={kind}", f"--seed_everything={seed}"]
    arguments = [*data_arguments(*data), *options.train_args, *own]
    checkpoint, seconds = train(variant, run, n_epochs, arguments, fresh=options.fresh)
    if checkpoint is None:
        print(f"{variant.name}: training failed; see {run / 'train.log'}", file=sys.stderr)
        return None
    volumes = validation_volumes(*data, CONFIG)
    made, steps = estimated(checkpoint, kind, volumes)
    return {
        "variant": variant.name,
        "seed": seed,
        "steps": steps,
        "train_seconds": round(seconds),
        "scores": scores(made, volumes),
    }


def estimated(checkpoint: Path, kind: str, volumes: Sequence[Mapping[str, Tensor]]) -> tuple[list[Tensor], int]:
    """V_prior of volumes from a network that cannot be exported, and the number of its training steps.

    Args:
        checkpoint: of the training.
        kind: of the density that the network reads.
        volumes: batches of one volume.
    """
    import torch

    from g3r.checkpoints.training_checkpoint import TRAINING_ENTRY
    from g3r.prior.config import PriorNetworkConfig
    from g3r.prior.dgpn import DensityGatedPriorNetwork
    from g3r.training.prior_batches import prior_inputs

    content = torch.load(checkpoint, map_location="cpu", weights_only=True)
    network = DensityGatedPriorNetwork(PriorNetworkConfig(**content[TRAINING_ENTRY]["network_arguments"])).eval()
    network.load_state_dict({name.removeprefix("network."): value for name, value in content["state_dict"].items()})
    with torch.inference_mode():
        return [network(prior_inputs(one, kind)).volume for one in volumes], int(content["global_step"])


def scores(made: Sequence[Tensor], volumes: Sequence[Mapping[str, Tensor]]) -> dict[str, float]:
    """PSNR in dB of the brain ("all", mean over volumes) and of its voxels in bins of coverage, pooled.

    Args:
        made: volumes [1, 1, I, J, K] to score.
        volumes: their truth, mask and density.
    """
    import torch

    from g3r.training.prior_validation import VALIDATED, ValidationScores, validation_means

    kept = ValidationScores(voxel_mm=1.0)  # any size will do, since rim and depth are pooled
    for volume, one in zip(made, volumes, strict=True):
        inside = (one["mask"] > 0.5).to(torch.float32)
        kept.add({name: volume for name in VALIDATED}, one, inside)
    return {"all": validation_means(kept.sums)["psnr_prior"], **psnr_by_bin(kept.squares)}


def psnr_by_bin(squares: Tensor) -> dict[str, float]:
    """PSNR (dB, of an intensity of 1) of the prior by bin of confidence, for bins with voxels.

    Args:
        squares: as for `g3r.training.prior_validation.psnr_by_place`.
    """
    from g3r.training.prior_validation import CONFIDENCE_BINS, VALIDATED

    of_prior = squares.double().cpu()[:, :, VALIDATED.index("prior")].sum(1).tolist()
    bins = zip(CONFIDENCE_BINS, of_prior, strict=True)
    return {name: 10 * log10(count / total) for name, (total, count) in bins if count and total > 0}


def tables(record: Record) -> dict[str, str]:
    """A row per variant with the spread over its seeds.

    Raises:
        InputError: no variant has been trained.
    """
    by_variant: dict[str, list[Row]] = {}
    for row in record["rows"].values():
        by_variant.setdefault(row["variant"], []).append(row)
    if not any("seed" in row for row in record["rows"].values()):
        raise InputError("the record holds no trained variant")
    names = list(next(iter(record["rows"].values()))["scores"])
    columns: dict[str, Cell] = {
        "": "{name}",
        "seeds": "{seeds}",
        **{_head(name): "{" + name + "}" for name in names},
        "steps": "{steps}",
        "trained, min": "{minutes}",
    }
    rows = []
    for name, found in by_variant.items():
        line: dict[str, Any] = {"name": name}
        line |= {one: spread([row["scores"][one] for row in found]) for one in names}
        if "seed" in found[0]:
            minutes = mean(row["train_seconds"] for row in found) / 60
            line |= {"seeds": len(found), "steps": found[0]["steps"], "minutes": f"{minutes:.0f}"}
        rows.append(line)
    head = (
        "PSNR in dB in the mask, and of its voxels by their confidence c (range 1, pooled over volumes): mean and "
        f"standard deviation over seeds. {record['val_subjects']} validation volumes. Trained with "
        f"`{' '.join(record['arguments']) or 'the configuration as it is'}`."
    )
    return {"gate": f"{head}\n\n{table(rows, columns)}"}


def _head(name: str) -> str:
    from g3r.training.prior_validation import CONFIDENCE_BINS

    if name == "all":
        return "all"
    low = 0.0
    for bin_name, high in CONFIDENCE_BINS.items():
        if bin_name == name:
            return f"c of {low:g} to {min(high, 1.0):g}"
        low = high
    raise KeyError(name)


STUDY = Study(
    name="prior.gate",
    about="Train the prior network with the density in F, in the gate, in both and in neither, for three definitions "
    "of it and several seeds, alike otherwise, and score them by coverage. Interrupted trainings go on.",
    document="prior.md",
    shared=("--threads", "--jobs", "--cache"),
    options={
        "--steps": {"type": positive, "default": 288, "metavar": "N", "help": "of the optimiser, to whole epochs"},
        "--seeds": {"type": positive, "nargs": "+", "default": SEEDS, "metavar": "N", "help": "of the trainings"},
        "--source": {"type": Path, "help": "atlas folder (None: the one of the test data)"},
        "--val-subjects": {"type": positive, "default": 6, "metavar": "N", "help": "volumes to compare on"},
        "train_args": {"nargs": "*", "metavar": "-- ARG", "help": "more of g3r-pretrain: --data.batch_size=2"},
    },
    settings=settings,
    tasks=tasks,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
