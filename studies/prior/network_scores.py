"""Comparison of trained variants of the prior network: errors by number of stacks, seconds, size."""

from __future__ import annotations

import contextlib
import functools
import io
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

import yaml

from g3r.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

LEFT_OUT = ("sta24", "sta30", "sta34")
VALIDATED_ON = ("*-operated",)
"""Atlas subjects of the trainings: LEFT_OUT are for testing, VALIDATED_ON choose checkpoints, the others train."""

SPEED_SHAPE = (129, 152, 130)
"""Voxels of a 36-week brain at 0.8 mm with its margin (`studies.prior.alone`)."""

REPEATS = 3
EXPORTED = "prior.safetensors"


BASELINES = {"V_coarse": "coarse", "V_sharp": "sharp"}
"""Inputs of the network, by their names in a validation volume."""


@functools.cache
def validation_volumes(source: Path, cache: Path, val_subjects: int, config: Path) -> list[dict[str, Tensor]]:
    """The volumes on which all variants are compared: the validation volumes of their training.

    Args:
        source: folder of the atlas.
        cache: folder of synthetic subjects.
        val_subjects: number of volumes.
        config: of the training.
    """
    from data_synth.prior_data import StackSynthesisDataModule

    settings = {
        **yaml.safe_load(config.read_text(encoding="utf-8"))["data"]["init_args"],
        "source": str(source),
        "cache": str(cache),
        "val_subjects": val_subjects,
        "exclude": list(LEFT_OUT),
        "val_include": list(VALIDATED_ON),
    }
    return list(StackSynthesisDataModule(**settings).val_dataloader())


def evaluate(checkpoint: Path, run: Path, volumes: Sequence[Mapping[str, Tensor]]) -> dict[str, Any]:
    """Export a variant and score it: errors by number of stacks, seconds for a whole brain, its size.

    Args:
        checkpoint: of the training.
        run: folder of the variant.
        volumes: to score it on.
    """
    import torch

    from g3r.cli import export
    from g3r.prior.model import Prior
    from g3r.training.prior_batches import prior_inputs

    exported = run / EXPORTED
    with contextlib.redirect_stdout(io.StringIO()):
        code = export.main([str(checkpoint), str(exported), "--force"])
    if code != 0:
        raise InputError(f"{checkpoint}: cannot be exported; remove {run} and train again")
    network = Prior.load(exported).network
    with torch.inference_mode():
        priors = [network(prior_inputs(one)).volume for one in volumes]
    content = torch.load(checkpoint, map_location="cpu", weights_only=True)
    return {
        "steps": int(content["global_step"]),
        "parameters": sum(value.numel() for value in network.parameters()),
        "seconds": inference_seconds(exported),
        "scores": scores_by_stacks(priors, volumes),
    }


def inference_seconds(exported: Path) -> float:
    """Wall seconds of one view of a whole brain, the minimum of a few runs."""
    import numpy as np

    from g3r.prior.maps import PriorMaps
    from g3r.prior.model import Prior

    prior = Prior.load(exported)
    rng = np.random.default_rng(0)
    names = ("coarse", "density", "share", "sharp", "template", "outline")
    maps = PriorMaps(**{name: rng.random(SPEED_SHAPE, dtype=np.float32) for name in names})
    seconds = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        prior.estimate(maps)
        seconds.append(time.perf_counter() - start)
    return round(min(seconds), 2)


def scores_by_stacks(made: Sequence[Tensor], volumes: Sequence[Mapping[str, Tensor]]) -> dict[str, dict[str, float]]:
    """Mean L1, PSNR (dB) and SSIM in the mask, for each number of stacks and over all ("all")."""
    from g3r.training.prior_validation import sample_scores

    rows: dict[str, list[tuple[float, float, float]]] = {}
    for volume, one in zip(made, volumes, strict=True):
        inside = (one["mask"][0] > 0.5).float()
        scores = sample_scores(volume[0], one["truth"][0], inside, weight=inside)
        row = (scores["l1"], scores["psnr"], scores["ssim"])
        for key in (str(int(one["n_stacks"][0])), "all"):
            rows.setdefault(key, []).append(row)
    return {
        key: {name: mean(row[n] for row in found) for n, name in enumerate(("l1", "psnr_db", "ssim"))}
        for key, found in sorted(rows.items())
    }
