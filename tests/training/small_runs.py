"""Short trainings, their TensorBoard logs, and exports of their checkpoints by `g3r-export`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import lightning.pytorch as lightning
import pytest
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch.utils.data import DataLoader, Dataset

from g3r.cli import export
from g3r.training.annealed_module import AnnealedModule


def trainer(folder: Path, **options: Any) -> lightning.Trainer:
    """A trainer on the CPU that logs every step to `folder / "run"`."""
    defaults = {
        "accelerator": "cpu",
        "logger": TensorBoardLogger(folder, name="run"),
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "num_sanity_val_steps": 0,
        "log_every_n_steps": 1,
    }
    return lightning.Trainer(default_root_dir=folder, **{**defaults, **options})


class Losses(lightning.Callback):
    """Callback that keeps the loss of every step, and can abort the run at a step like a kill."""

    def __init__(self, end_at: int | None = None) -> None:
        self.found: dict[int, float] = {}
        self.end_at = end_at

    def on_train_batch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, outputs: Any, batch: object, batch_idx: int
    ) -> None:
        self.found[trainer.global_step] = float(outputs["loss"])
        if trainer.global_step == self.end_at:
            raise ZeroDivisionError


def assert_resuming_changes_nothing(
    make_module: Callable[[], AnnealedModule],
    make_data: Callable[[], lightning.LightningDataModule],
    folder: Path,
    n_epochs: int = 3,
) -> None:
    """Assert that resuming from the first epoch's checkpoint gives the losses and weights of the uninterrupted run."""

    def run(seed: int, resume: Path | None = None) -> tuple[dict[int, float], AnnealedModule]:
        torch.manual_seed(seed)
        module, losses = make_module(), Losses()
        keeper = lightning.callbacks.ModelCheckpoint(folder, filename="{epoch}", save_top_k=-1)
        one = trainer(folder, max_epochs=n_epochs, logger=False, callbacks=[losses, keeper])
        one.fit(module, make_data(), ckpt_path=resume, weights_only=True if resume else None)
        return losses.found, module

    whole, module = run(0)
    n_steps = len(whole)
    assert n_steps % n_epochs == 0
    assert len(set(whole.values())) == n_steps
    resumed, other = run(1, folder / "epoch=0.ckpt")
    assert resumed == {step: loss for step, loss in whole.items() if step > n_steps // n_epochs}
    found = other.state_dict()
    for name, value in module.state_dict().items():
        assert torch.equal(found[name], value), name


def in_memory(samples: list[dict[str, torch.Tensor]], batch_size: int | None = None) -> DataLoader:
    """A loader of given samples."""
    return DataLoader(cast(Dataset, samples), batch_size=batch_size)


def logged(folder: Path) -> Any:
    """TensorBoard's data of one version of a run."""
    accumulators = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    found = accumulators.EventAccumulator(str(folder))
    found.Reload()
    return found


def assert_export_refuses(
    checkpoint: Path,
    alter: Callable[[dict[str, Any]], object],
    says: str,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Assert that an altered training checkpoint is refused in one line, and nothing is written."""
    content = torch.load(checkpoint, weights_only=True)
    alter(content)
    torch.save(content, folder / "run.ckpt")
    assert export.main([str(folder / "run.ckpt"), str(folder / "out.safetensors")]) == 3
    line = capsys.readouterr().err
    assert says in line
    assert line.count("\n") == 1
    assert not (folder / "out.safetensors").exists()
