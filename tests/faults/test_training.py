"""A killed training resumes with the same losses, and its checkpoints are complete."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from g3r.errors import InputError
from g3r.run.process_mark import process_mark
from tests.tally import Tally

pytest.importorskip("lightning.pytorch", reason="the training extra is not installed")
pytest.importorskip("torchio", reason="the training extra is not installed")

import lightning.pytorch as lightning

from data_synth.prior_data import StackSynthesisDataModule
from g3r.prior.config import PriorNetworkConfig
from g3r.training.prior_module import PriorModule
from g3r.training.whole_checkpoints import WholeCheckpoints
from tests.training.small_runs import Losses

NETWORK = PriorNetworkConfig(channels=(4, 4), units=(1, 1), tail_channels=2, template_spacing_mm=3.0)
# ten patches per epoch in batches of three leave one over each time
DATA: dict[str, Any] = {
    "spacing_mm": 2.0,
    "patch_size": 24,
    "patches_per_subject": 2,
    "batch_size": 3,
    "subjects_per_epoch": 5,
    "val_subjects": 1,
    "val_crop": 24,
    "template_spacing_mm": 3.0,
    "seed": 3,
}
N_EPOCHS = 4


def trained(folder: Path, end_at: int | None = None, resume: Path | None = None) -> dict[int, float]:
    """Losses of a tiny training by step."""
    lightning.seed_everything(5)
    losses = Losses(end_at)
    best = lightning.callbacks.ModelCheckpoint(folder, filename="best", monitor="val/l1_prior")
    last = lightning.callbacks.ModelCheckpoint(folder, filename="last", enable_version_counter=False)
    trainer = lightning.Trainer(
        accelerator="cpu",
        max_epochs=N_EPOCHS,
        default_root_dir=folder,
        logger=False,
        num_sanity_val_steps=0,
        enable_progress_bar=False,
        enable_model_summary=False,
        callbacks=[best, last, losses],
        plugins=[WholeCheckpoints()],
    )
    try:
        module, data = PriorModule(NETWORK, warmup_steps=2), StackSynthesisDataModule(**DATA)
        trainer.fit(module, data, ckpt_path=resume, weights_only=True if resume else None)
    except ZeroDivisionError:
        assert end_at is not None
    return losses.found


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[int, float]:
    return trained(tmp_path_factory.mktemp("whole"))


@pytest.mark.faults
def test_a_training_is_the_same_when_repeated(whole: dict[int, float], tmp_path: Path) -> None:
    assert len(whole) == 3 * N_EPOCHS
    assert trained(tmp_path) == whole


@pytest.mark.faults
@pytest.mark.filterwarnings("ignore:Checkpoint directory")  # the resumed run writes to the same folder
@pytest.mark.parametrize("end_at", [4, 11])
def test_a_training_that_ended_goes_on_at_the_same_losses(
    whole: dict[int, float], tmp_path: Path, tally: Tally, end_at: int
) -> None:
    with tally.case():
        begun = trained(tmp_path, end_at)
        assert begun == {step: whole[step] for step in range(1, end_at + 1)}
        resumed = trained(tmp_path, resume=tmp_path / "last.ckpt")
        last_epoch = (end_at - 1) // 3 * 3  # checkpoints are written at the end of an epoch
        assert resumed == {step: loss for step, loss in whole.items() if step > last_epoch}


def test_a_checkpoint_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tally: Tally) -> None:
    path, keeper = tmp_path / "last.ckpt", WholeCheckpoints()
    keeper.save_checkpoint({"a": torch.ones(3)}, path)

    def full(content: object, file: Path) -> None:
        file.write_bytes(b"half of it")
        raise OSError(28, "No space left on device")

    with tally.case() as one:
        monkeypatch.setattr(torch, "save", full)
        with pytest.raises(InputError, match="No space left on device"):
            keeper.save_checkpoint({"a": torch.zeros(3)}, path)
        assert [one.name for one in tmp_path.iterdir()] == ["last.ckpt"]
        one.refused()
    with tally.case():
        living = process_mark()
        for mark in (f"{living.partition('-')[0]}-4194399", living):  # of an ended and of a living process
            (tmp_path / f".{mark}-0.last.ckpt").write_text("")
        assert torch.equal(keeper.load_checkpoint(path, weights_only=True)["a"], torch.ones(3))
        left = {one.name for one in tmp_path.iterdir()}
        assert left == {"last.ckpt", f".{living}-0.last.ckpt"}


CONFIG = """
seed_everything: 5
model:
  class_path: g3r.training.prior_module.PriorModule
  init_args:
    {network: {channels: [4, 4], units: [1, 1], tail_channels: 2, template_spacing_mm: 3.0}, warmup_steps: 2}
data:
  class_path: data_synth.prior_data.StackSynthesisDataModule
  init_args:
    {spacing_mm: 3.0, patch_size: 24, patches_per_subject: 2, batch_size: 3, subjects_per_epoch: 5,
     val_subjects: 1, val_crop: 24, seed: 3, num_workers: 1, template_spacing_mm: 3.0}
trainer:
  accelerator: cpu
  max_epochs: 5
  log_every_n_steps: 1
  num_sanity_val_steps: 0
  enable_progress_bar: false
  enable_model_summary: false
  logger: {class_path: lightning.pytorch.loggers.CSVLogger, init_args: {save_dir: FOLDER, name: run}}
  callbacks:
    - class_path: lightning.pytorch.callbacks.ModelCheckpoint
      init_args: {dirpath: FOLDER/kept, monitor: val/l1_prior}
    - class_path: lightning.pytorch.callbacks.ModelCheckpoint
      init_args: {dirpath: FOLDER/kept, filename: last, enable_version_counter: false}
"""


def command(folder: Path, *options: str) -> list[str]:
    folder.mkdir(exist_ok=True)
    (folder / "config.yaml").write_text(CONFIG.replace("FOLDER", str(folder)))
    return [sys.executable, "-m", "g3r.cli.pretrain", "fit", "--config", str(folder / "config.yaml"), *options]


def losses(folder: Path) -> dict[int, float]:
    """Loss of every step from the logs of all runs; later runs override earlier ones."""
    found: dict[int, float] = {}
    for path in sorted(folder.glob("run/version_*/metrics.csv")):
        with path.open() as file:
            rows = [row for row in csv.DictReader(file) if row["train/l1_prior"]]
        found |= {int(row["step"]): float(row["train/l1_prior"]) for row in rows}
    return found


@pytest.mark.faults
def test_the_command_killed_again_and_again_ends_with_the_same_losses(tmp_path: Path, tally: Tally) -> None:
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    done = subprocess.run(command(tmp_path / "whole"), check=False, **quiet)
    assert done.returncode == 0, done.stderr
    folder, last = tmp_path / "killed", tmp_path / "killed" / "kept" / "last.ckpt"
    for n_more in (0.3, 1.3):  # seconds after a new checkpoint
        with tally.case():
            before = last.stat().st_mtime_ns if last.exists() else 0
            options = ["--ckpt_path", str(last)] if last.exists() else []
            run = subprocess.Popen(
                command(folder, *options), start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            while run.poll() is None and not (last.exists() and last.stat().st_mtime_ns > before):
                time.sleep(0.02)
            time.sleep(n_more)
            if run.poll() is None:
                os.killpg(run.pid, signal.SIGKILL)
            run.wait()
            torch.load(last, weights_only=True)
    with tally.case():
        done = subprocess.run(command(folder, "--ckpt_path", str(last)), check=False, **quiet)
        assert done.returncode == 0, done.stderr
        # sums may be rounded differently in another process, and training propagates the difference
        assert losses(folder) == pytest.approx(losses(tmp_path / "whole"), rel=1e-4)
        assert len(losses(folder)) == 15
        assert not list(folder.glob("kept/.*"))
