"""Initial weights of a training, from an exported file or from a training checkpoint."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from g3r.checkpoints.trained_model import TrainedModel
from g3r.checkpoints.training_checkpoint import read_training
from g3r.checkpoints.weights_file import SUFFIX
from g3r.errors import InputError

Model = TypeVar("Model", bound=TrainedModel)

OPTION = "model.start_from"


def take_weights(network: Any, path: str, model_type: type[Model]) -> Model:
    """Put the weights of another network into one of the same size.

    The atlas template stays, since it is that of the data. Volumes that the other network does not see must be the last
    inputs of this one; their channels start at zero.

    Args:
        network: takes the weights; its `config` may name its `inputs`.
        path: a file of `g3r-export`, or a training checkpoint of `g3r-pretrain`.
        model_type: kind of the network.

    Returns:
        The other network, with its facts.

    Raises:
        InputError: the file cannot be read, is of another kind or of other conventions, or its network has another
            size or other inputs.
    """
    try:
        is_exported = Path(path).suffix == SUFFIX
        other = model_type.load(path) if is_exported else read_training(Path(path)).model(model_type)
    except InputError as error:
        raise InputError(f"{OPTION}: {error}") from error
    own, given = network.state_dict(), other.network.state_dict()
    mine, theirs = network.config, other.network.config
    more_inputs = len(_inputs(mine)) > len(_inputs(theirs))
    fits = own.keys() == given.keys() and _inputs(mine)[: len(_inputs(theirs))] == _inputs(theirs)
    for name in own.keys() & given.keys() - {"template"}:
        into, value = own[name].shape, given[name].shape
        widened = len(into) == len(value) > 1 and (into[0], into[2:]) == (value[0], value[2:]) and into[1] > value[1]
        fits &= into == value or (more_inputs and widened)
    if not fits:
        raise InputError(
            f"{OPTION}: {path} holds {theirs}, and this network is {mine}; give it the same size and inputs by "
            "--model.network, or leave the option out"
        )
    for name, value in given.items():
        if name == "template":
            continue
        if own[name].shape == value.shape:
            own[name].copy_(value)
        else:
            own[name].zero_()
            own[name][:, : value.shape[1]] = value
    return other


def _inputs(config: Any) -> tuple[str, ...]:
    """Names of the volumes that a network sees, if their number is not the same in all networks of its kind."""
    return getattr(config, "inputs", ())
