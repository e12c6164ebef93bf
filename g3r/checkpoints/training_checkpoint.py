"""Training checkpoints of `g3r-pretrain`: the network in them, and what an export or a further training needs.

They are Lightning's files with one entry of ours, which holds plain values only.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from g3r.checkpoints.plain_values import shown
from g3r.checkpoints.trained_model import TrainedModel
from g3r.errors import G3RError, InputError, is_out_of_memory, one_line

if TYPE_CHECKING:
    from torch import Tensor

Model = TypeVar("Model", bound=TrainedModel)

TRAINING_ENTRY = "g3r_export"
"""Entry of a Lightning checkpoint that holds, as plain values, the facts that an export needs besides the weights."""
EXPECTED = "expected a training checkpoint of g3r-pretrain, such as .../checkpoints/last.ckpt"


@dataclass(frozen=True)
class TrainingCheckpoint:
    """A training checkpoint that has been read.

    Attributes:
        path: of the file.
        entry: the facts that the training recorded.
        state: all its weights by name; those of the network begin with "network.".
    """

    path: Path
    entry: Mapping[str, Any]
    state: Mapping[str, Tensor]

    def model(self, model_type: type[Model], training_data: str | None = None) -> Model:
        """The trained network with its facts.

        Args:
            model_type: kind of the network.
            training_data: its training data, in words; None for those that the run recorded.

        Raises:
            InputError: it is a network of another kind, its weights are not finite, its conventions are not those of
                this version, or entries or weights do not fit together.
        """
        try:
            if self.entry["kind"] != model_type.kind:
                found = shown(self.entry["kind"])
                raise InputError(f"{self.path}: holds a network of kind {found}; expected {model_type.kind!r}")
            if not all(bool(value.isfinite().all()) for value in self.state.values()):
                raise InputError(f"{self.path}: the weights hold NaN or infinity; use an earlier checkpoint of the run")
            check_conventions(self.entry, model_type.conventions, str(self.path))
            prefix = "network."
            weights = {
                name.removeprefix(prefix): value for name, value in self.state.items() if name.startswith(prefix)
            }
            recorded = f"{self.entry['training_data']}; {self.entry['optimiser_steps']} optimiser steps"
            return model_type.from_training(self.entry, weights, recorded if training_data is None else training_data)
        except G3RError:
            raise
        except Exception as error:  # a network with unexpected values may raise anything
            if is_out_of_memory(error):
                raise
            raise InputError(f"{self.path}: cannot be used ({one_line(error)}); use another checkpoint") from error


def read_training(path: Path) -> TrainingCheckpoint:
    """Read a training checkpoint. Nothing in it is executed.

    Raises:
        InputError: the file is missing, damaged or of another kind.
    """
    import torch

    try:
        with warnings.catch_warnings(action="ignore"):  # the error message replaces torch's warnings
            content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; {EXPECTED}") from error
    except Exception as error:  # torch.load raises many types for a damaged file
        if is_out_of_memory(error):
            raise
        raise InputError(f"{path}: cannot be read as a checkpoint ({type(error).__name__}); {EXPECTED}") from error
    whole = content if isinstance(content, dict) else {}
    entry, state = whole.get(TRAINING_ENTRY), whole.get("state_dict")
    if not (isinstance(entry, dict) and "kind" in entry and isinstance(state, dict)):
        raise InputError(f"{path}: is no checkpoint of g3r-pretrain; {EXPECTED}")
    if not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise InputError(f"{path}: its weights are no tensors; {EXPECTED}")
    return TrainingCheckpoint(path, entry, state)


def check_conventions(entry: Mapping[str, Any], expected: Mapping[str, str], source: str) -> None:
    """Check that a training went by the conventions of this version: the weights mean nothing with others.

    Args:
        entry: the training's entry `TRAINING_ENTRY`.
        expected: conventions of the kind of network.
        source: file or option, for the message.

    Raises:
        InputError: a convention differs or, in checkpoints of earlier versions, is not recorded.
    """
    found = entry.get("conventions", {})
    by = f"g3r {entry['g3r_version']}" if "g3r_version" in entry else "an earlier g3r"
    for name, value in expected.items():
        if found.get(name) != value:
            said = f"is {shown(found[name])}" if name in found else "is not recorded"
            raise InputError(
                f"{source}: its {name.replace('_', ' ')} {said} (trained by {by}), that of this g3r is {value!r}; "
                "use it with the version that trained it, or train again"
            )
