"""Short trainings, what they write to TensorBoard, and what `g3r-export` makes of their checkpoints."""

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


def in_memory(samples: list[dict[str, torch.Tensor]], batch_size: int | None = None) -> DataLoader:
    """A loader of samples that are there already."""
    return DataLoader(cast(Dataset, samples), batch_size=batch_size)


def logged(folder: Path) -> Any:
    """What TensorBoard finds in the folder of one version of a run."""
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
    """An altered training checkpoint is refused in one line, and nothing is written."""
    content = torch.load(checkpoint, weights_only=True)
    alter(content)
    torch.save(content, folder / "run.ckpt")
    assert export.main([str(folder / "run.ckpt"), str(folder / "out.safetensors")]) == 3
    line = capsys.readouterr().err
    assert says in line
    assert line.count("\n") == 1
    assert not (folder / "out.safetensors").exists()
