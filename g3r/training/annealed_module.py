"""Common base of the trainings: optimiser annealed over a budget, throughput, and the facts that an export needs."""

import inspect
import math
import os
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from lightning.pytorch import LightningModule
from lightning.pytorch.callbacks import Timer
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from g3r._version import __version__
from g3r.checkpoints.trained_model import NetworkConfig, TrainedModel
from g3r.checkpoints.training_checkpoint import TRAINING_ENTRY
from g3r.errors import InputError
from g3r.training.initial_weights import take_weights
from g3r.training.resumption import check_resumed, use_present_rates

FINAL_FACTOR = 0.01
"""Learning rate at the end over the peak rate."""


class AnnealedModule(LightningModule):
    """A module that trains its `network` by AdamW over the budget of the trainer.

    The learning rate warms up over `warmup_steps`, then follows half a cosine to 1 % by the budget that
    runs out first: `max_epochs`, `max_steps` or `max_time` of the trainer. So a run of 70 minutes ends
    annealed on any machine.

    Args:
        learning_rate: peak rate of AdamW.
        weight_decay: weight decay of AdamW.
        warmup_steps: steps of linear warm-up.
        start_from: file with the initial weights, see `take_weights`. It is read when a training begins, and not when
            one goes on from a checkpoint.

    Raises:
        ValueError: a rate is out of range.
    """

    model_type: ClassVar[type[TrainedModel]]
    """The exported model: prior, pose or mask network."""
    network: Any
    weeks: list[float]
    """Gestational ages of the heads of the atlas template, of networks with one."""

    def __init__(
        self, learning_rate: float, weight_decay: float, warmup_steps: int, start_from: str | None = None
    ) -> None:
        super().__init__()
        if not (learning_rate > 0 and weight_decay >= 0 and warmup_steps >= 0):
            raise ValueError(f"got {learning_rate=}, {weight_decay=}, {warmup_steps=}")
        self.learning_rate = learning_rate
        self.weight_decay = weight_decay
        self.warmup_steps = warmup_steps
        self._total_steps = math.inf
        self._timer: Timer | None = None
        self._throughput = _Throughput()
        self._training_data = "not recorded"
        self._start_from = start_from

    def n_samples(self, batch: Any) -> int:
        """Number of samples of a batch."""
        raise NotImplementedError

    def own_description(self) -> dict[str, Any]:
        """Plain values that the exported model needs besides its weights."""
        raise NotImplementedError

    def keep_hyperparameters(self, network: NetworkConfig) -> None:
        """Log the constructor's arguments; call it from the constructor.

        The network's arguments are kept as plain values: a checkpoint with a class of ours could not be read safely.
        """
        self.save_hyperparameters(ignore=["network"], frame=inspect.currentframe().f_back)  # type: ignore[union-attr]
        self.save_hyperparameters({"network": asdict(network)})

    def on_fit_start(self) -> None:
        """Take the initial weights, unless a checkpoint to go on with has been loaded by now."""
        self.take_initial_weights()

    def on_validation_start(self) -> None:
        """Take the initial weights where nothing is trained."""
        self.take_initial_weights()

    def take_initial_weights(self) -> None:
        """Take the initial weights, once.

        Raises:
            InputError: see `take_weights`.
        """
        path, self._start_from = self._start_from, None
        if path is not None:
            self.begin_with(path)

    def begin_with(self, path: str) -> TrainedModel:
        """Take the initial weights from a file; returns the network in it."""
        return take_weights(self.network, path, self.model_type)

    def describe_data(self) -> dict[str, Any]:
        """Record the data module in words; return its settings."""
        data = getattr(self.trainer, "datamodule", None)
        settings = dict(getattr(data, "hparams", None) or {})
        self._training_data = data_in_words(data, settings)
        return settings

    def check_data(self, *names: str) -> None:
        """Record the data module in words; check that its settings of some names are those of the network.

        Raises:
            InputError: they differ.
        """
        settings = self.describe_data()
        for name in names:
            mine, theirs = getattr(self.network.config, name), settings.get(name)
            if theirs is not None and theirs != mine:
                raise InputError(f"data.{name}: {theirs}, but the network looks at {mine}; leave it out")

    def take_template(self) -> None:
        """Take the atlas template of the data module, and the ages of its heads, if it has one.

        Raises:
            InputError: the template is on another grid than the network's.
        """
        data: Any = getattr(self.trainer, "datamodule", None)
        if not hasattr(data, "template"):
            return
        template = data.template()
        self.network.set_template(torch.from_numpy(template.volume))
        config = self.network.config  # may have taken the shape of the template
        if not np.allclose(template.affine, config.template_grid.affine, atol=1e-3):
            raise InputError(
                f"data: the template is not on a grid of {config.template_spacing_mm:g} mm about the origin; "
                "pass --model.network.template_spacing_mm"
            )
        self.weeks = [float(week) for week in template.weeks]

    def log_image(self, tag: str, image: Tensor) -> None:
        """Log an image [rows, columns], values 0 to 1, to TensorBoard."""
        for board in self.loggers:
            if isinstance(board, TensorBoardLogger):
                board.experiment.add_image(tag, image, global_step=self.global_step, dataformats="HW")

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what `g3r-export` needs, as plain values only."""
        metrics = {name: float(value) for name, value in self.trainer.callback_metrics.items()}
        checkpoint[TRAINING_ENTRY] = {
            "kind": self.model_type.kind,
            "g3r_version": __version__,
            "conventions": dict(self.model_type.conventions),
            "network_arguments": asdict(self.network.config),
            "training_data": self._training_data,
            "optimiser_steps": int(self.global_step),
            "validation": {name: value for name, value in metrics.items() if name.startswith("val/")},
            **self.own_description(),
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check that a checkpoint is one of this training; the optimiser goes on with the settings of now.

        Raises:
            InputError: see `check_resumed`.
        """
        check_resumed(checkpoint, self.model_type, self.network.config)
        self._start_from = None
        if self.trainer.state.fn == "fit":
            use_present_rates(checkpoint, self.learning_rate, self.weight_decay)

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Note when the data arrived, and seed the step's own random numbers.

        The seed depends only on the run's seed, the number of the step, that of the device and, where gradients of
        several batches make a step, that of the batch in it. So a killed run that is resumed from a checkpoint draws
        the numbers that it would have drawn.
        """
        self._throughput.start_batch()
        run_seed = int(os.environ.get("PL_GLOBAL_SEED", "0"))
        # a last number of 0 leaves the seed as it would be without it
        numbers = [run_seed, self.global_step, self.global_rank, batch_idx % self.trainer.accumulate_grad_batches]
        seed = np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0]
        torch.manual_seed(int(seed >> np.uint64(1)))

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Log samples per second and the share of time spent waiting for data.

        Args:
            outputs: outputs of the training step; not used.
            batch: the training batch.
            batch_idx: its number in the epoch, from 0.
        """
        self._throughput.end_batch(self.n_samples(batch))
        every = max(self.trainer.log_every_n_steps, 1)  # type: ignore[attr-defined]
        if (batch_idx + 1) % every == 0 or self.trainer.is_last_batch:
            samples_per_second, waiting = self._throughput.read_and_reset()
            self.log("train/samples_per_second", samples_per_second, prog_bar=True)
            self.log("train/waiting_for_data", waiting)

    def on_train_epoch_start(self) -> None:
        """Reset the throughput, to leave out the time spent in validation."""
        self._throughput = _Throughput()

    def configure_optimizers(self) -> Any:
        """Return AdamW with warm-up and a cosine over the trainer's budget."""
        # Without normalisation layers one batch can have a far larger gradient than those before; with the
        # usual 0.999 the second moment is then too small and a single step throws the network far off.
        optimizer = torch.optim.AdamW(
            self.parameters(), lr=self.learning_rate, betas=(0.9, 0.95), weight_decay=self.weight_decay
        )
        total = self.trainer.estimated_stepping_batches
        self._total_steps = float(total) if total > 0 else math.inf
        self._timer = next((c for c in self.trainer.callbacks if isinstance(c, Timer)), None)  # type: ignore[attr-defined]
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, self._rate_factor)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": "step", "name": "train/learning_rate"},
        }

    def _rate_factor(self, step: int) -> float:
        """Return the learning rate's factor at a step, in (0, 1]."""
        progress = step / self._total_steps
        if self._timer is not None:
            elapsed, remaining = self._timer.time_elapsed(), self._timer.time_remaining()
            if remaining is not None and elapsed > 0:
                progress = max(progress, elapsed / (elapsed + max(remaining, 0.0)))
        return min((step + 1) / (self.warmup_steps + 1), 1.0) * cosine_factor(progress)


class _Throughput:
    """Samples per second, and the share of the time in which training waits for data."""

    def __init__(self) -> None:
        self._since = self._arrived = self._ended = time.monotonic()
        self._n_samples = 0
        self._waited_seconds = 0.0

    def start_batch(self) -> None:
        self._arrived = time.monotonic()
        self._waited_seconds += self._arrived - self._ended

    def end_batch(self, n_samples: int) -> None:
        self._ended = time.monotonic()
        self._n_samples += n_samples

    def read_and_reset(self) -> tuple[float, float]:
        seconds = max(self._ended - self._since, 1e-9)
        result = self._n_samples / seconds, min(self._waited_seconds / seconds, 1.0)
        self._since, self._n_samples, self._waited_seconds = self._ended, 0, 0.0
        return result


def cosine_factor(progress: float) -> float:
    """Return half a cosine from 1 at progress 0 to `FINAL_FACTOR` at progress 1 and beyond."""
    return FINAL_FACTOR + (1.0 - FINAL_FACTOR) * 0.5 * (1.0 + math.cos(math.pi * min(max(progress, 0.0), 1.0)))


def data_in_words(data: object, settings: Mapping[str, Any]) -> str:
    """Return the data module and its settings in one line, with folders by name only.

    The line goes into files that are passed on, which should not show the folders of this machine.
    """
    if data is None:
        return "not recorded"
    plain = {
        name: Path(value).name if isinstance(value, (str, Path)) and "/" in str(value) else value
        for name, value in settings.items()
        if not name.startswith("_")
    }
    listed = ", ".join(f"{name}={value}" for name, value in plain.items())
    return f"{type(data).__module__}.{type(data).__qualname__}({listed})"
