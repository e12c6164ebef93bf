"""Training that goes on from a checkpoint: it must be of the same network; settings of the optimiser may change."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from g3r.checkpoints.trained_model import NetworkConfig, TrainedModel
from g3r.checkpoints.training_checkpoint import TRAINING_ENTRY, check_conventions
from g3r.errors import InputError

logger = logging.getLogger(__name__)

OPTION = "ckpt_path"


def check_resumed(checkpoint: Mapping[str, Any], model_type: type[TrainedModel], network: NetworkConfig) -> None:
    """Check that a checkpoint is one of this training.

    Args:
        checkpoint: Lightning's state of the training.
        model_type: kind of the network that is trained now.
        network: arguments of that network.

    Raises:
        InputError: it is one of another kind, network or convention.
    """
    entry = checkpoint.get(TRAINING_ENTRY)
    if entry is None or entry["kind"] != model_type.kind:
        found = "another program" if entry is None else f"a {entry['kind']} network"
        raise InputError(f"{OPTION}: is of {found}; pass a training checkpoint of a {model_type.kind} network")
    check_conventions(entry, model_type.conventions, OPTION)
    before, now = entry["network_arguments"], asdict(network)
    other = [name for name in sorted(before.keys() | now.keys()) if before.get(name) != now.get(name)]
    if other:
        was, given = (", ".join(f"{name} {one.get(name)}" for name in other) for one in (before, now))
        raise InputError(
            f"{OPTION}: its network has {was}, this one has {given}; resume with the same data and the same "
            "--model.network options"
        )


def use_present_rates(checkpoint: Mapping[str, Any], learning_rate: float, weight_decay: float) -> None:
    """Put the optimiser's settings of now in the place of those that a checkpoint would restore.

    Args:
        checkpoint: Lightning's state of the training; it is changed.
        learning_rate: peak rate.
        weight_decay: weight decay.
    """
    for state in checkpoint.get("optimizer_states", []):
        for group in state["param_groups"]:
            _say_what_changed("learning_rate", group["initial_lr"], learning_rate)
            _say_what_changed("weight_decay", group["weight_decay"], weight_decay)
            if group["initial_lr"] != learning_rate:
                group["lr"] *= learning_rate / group["initial_lr"]  # it is a share of the peak rate
            group.update(initial_lr=learning_rate, weight_decay=weight_decay)
    for scheduler in checkpoint.get("lr_schedulers", []):
        scheduler["base_lrs"] = [learning_rate] * len(scheduler["base_lrs"])


def _say_what_changed(name: str, before: float, now: float) -> None:
    if before != now:
        logger.warning("model.%s: %g in %s; %g holds from here on", name, before, OPTION, now)
