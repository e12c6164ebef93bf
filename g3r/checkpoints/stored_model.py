"""An exported network that is loaded on demand or in advance; the description in its file is read at once."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from g3r.checkpoints.shipped import WEIGHTS, weights_path
from g3r.checkpoints.weights_file import WeightsFile, read_weights
from g3r.run.ahead import Ahead

if TYPE_CHECKING:
    from g3r.checkpoints.trained_model import TrainedModel

Model = TypeVar("Model", bound="TrainedModel")

OF_THE_FILE = ("format", "format_version", "weights_sha256")
"""Entries of a description about the file rather than the network."""


class StoredModel(Generic[Model]):
    """A network in its file, loaded on demand.

    Weights that ship with the package are loaded on demand: torch and the network's libraries take seconds to import.
    Other files are loaded at once, so that any error in them shows immediately.

    Args:
        source: see `TrainedModel.load`.
        kind: kind of the file, such as "prior".
        load: builds the network of a file, on its device.

    Raises:
        InputError: see `TrainedModel.load`.
    """

    def __init__(
        self, source: str | os.PathLike[str] | WeightsFile | None, kind: str, load: Callable[[WeightsFile], Model]
    ) -> None:
        found = source if isinstance(source, WeightsFile) else read_weights(weights_path(source, kind), kind)
        self.file = found
        self._model = Ahead(lambda: load(found))
        if not self.ships:
            self._model.value()

    @property
    def ships(self) -> bool:
        """Whether the file is part of the package."""
        return self.file.path.parent == WEIGHTS

    @property
    def model(self) -> Model:
        """The network, loaded now if it is not loaded yet."""
        return self._model.value()

    def start(self) -> None:
        """Start loading the network in a background thread."""
        self._model.start()

    def record(self) -> dict[str, Any]:
        """All facts in plain values, for run.json."""
        return {name: fact for name, fact in self.file.description.items() if name not in OF_THE_FILE}

    def array(self, name: str) -> NDArray[np.float32]:
        """One of the weights, read without torch."""
        from safetensors.numpy import load

        return load(self.file.content)[name].astype(np.float32)
