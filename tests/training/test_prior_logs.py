"""Logs of a prior training: scores and images by number of stacks; resuming after a kill."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch.utils.data import DataLoader

pytest.importorskip("lightning.pytorch", reason="the training extra is not installed")

import lightning.pytorch as lightning

from g3r.acquisition.images import save_volume
from g3r.cli import export
from g3r.errors import InputError
from g3r.prior.config import PriorNetworkConfig
from g3r.prior.model import Prior
from g3r.reconstruct import GaussianReconstructor
from g3r.training import prior_module as training
from g3r.training import prior_validation as validation
from g3r.training.prior_batches import loss_weight
from tests.training.small_runs import in_memory, logged, trainer

NETWORK = PriorNetworkConfig(channels=(8, 8), units=(1, 1), tail_channels=4)
TINY_TRAINING = [
    "--config",
    "lightning_configs/prior.yaml",
    "--model.network.channels=[8,8]",
    "--model.network.units=[1,1]",
    "--model.network.template_spacing_mm=3.0",
    "--data.template_spacing_mm=3.0",
    "--data.spacing_mm=3.0",
    "--data.patch_size=16",
    "--data.patches_per_subject=4",
    "--data.batch_size=4",
    "--data.subjects_per_epoch=2",
    "--data.val_subjects=2",
    "--data.val_crop=16",
    "--data.num_workers=0",
    "--trainer.accelerator=cpu",
    "--trainer.log_every_n_steps=1",
    "--trainer.enable_progress_bar=false",
    "--trainer.max_time=null",
]


def volumes(n: int, seed: int = 0, size: int = 12) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    names = ("coarse", "density", "share", "sharp", "template", "outline", "truth")
    batch = {name: torch.rand(n, 1, size, size, size, generator=generator) for name in names}
    return {**batch, "mask": torch.ones_like(batch["truth"])}


class ValidatedByStacks(lightning.LightningDataModule):
    """Volumes of one, three and again three stacks, in a batch of one and a batch of two."""

    spacing_mm = 0.8

    def train_dataloader(self) -> DataLoader:
        return in_memory([volumes(2)])

    def val_dataloader(self) -> DataLoader:
        batches = [
            {**volumes(1, 1), "n_stacks": torch.tensor([1])},
            {**volumes(2, 2), "n_stacks": torch.tensor([3, 3])},
        ]
        return in_memory(batches)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """TensorBoard's data of two epochs."""
    folder = tmp_path_factory.mktemp("logs")
    torch.manual_seed(0)
    run = trainer(folder, max_epochs=2)
    run.fit(training.PriorModule(NETWORK), ValidatedByStacks())
    return logged(folder / "run" / "version_0")


def test_scores_by_number_of_stacks_are_logged(log: Any) -> None:
    tags = set(log.Tags()["scalars"])
    for stacks in ("", "_1stack", "_3stacks"):
        expected = {f"val/{m}_{v}{stacks}" for m in ("l1", "psnr", "ssim") for v in validation.VALIDATED}
        assert expected | {f"val/psnr_gain{stacks}"} <= tags
    assert not any("2stacks" in tag for tag in tags)
    assert {"train/samples_per_second", "train/waiting_for_data", "train/l1_prior"} <= tags


def test_scores_are_means_over_volumes(log: Any) -> None:
    def last(tag: str) -> float:
        return log.Scalars(tag)[-1].value

    expected = (last("val/psnr_coarse_1stack") + 2 * last("val/psnr_coarse_3stacks")) / 3
    assert last("val/psnr_coarse") == pytest.approx(expected, abs=1e-4)
    assert last("val/psnr_gain") == pytest.approx(last("val/psnr_prior") - last("val/psnr_coarse"), abs=1e-4)
    one = next(iter(ValidatedByStacks().val_dataloader()))
    weight = loss_weight(one, 1.0)
    l1 = float((weight * (one["coarse"] - one["truth"]).abs()).sum() / weight.sum())
    assert last("val/l1_coarse_1stack") == pytest.approx(l1, abs=1e-6)


def test_images_show_gate_and_confidence_for_each_number_of_stacks(log: Any) -> None:
    tags = log.Tags()["images"]
    assert sorted(tags) == [f"val/{n}: {validation.PANEL_TAG}" for n in ("1stack", "3stacks")]
    assert "confidence, gate" in validation.PANEL_TAG
    image = log.Images(tags[0])[-1]
    assert (image.height, image.width) == (12, 8 * 12)


def test_panel_of_a_network_without_a_gate() -> None:
    batch = volumes(1)
    shown = validation.panel(batch, batch["coarse"], None)
    coarse, _, _, confidence, gate, prior, _, _ = shown.split(12, 1)
    assert bool((gate == 1).all())
    assert 0 < float(confidence.max()) < 1
    assert torch.equal(prior, coarse)  # V_coarse takes the place of the prior here


def test_going_on_at_another_voxel_size_is_refused(tmp_path: Path) -> None:
    """Weights trained at 0.8 mm, from a prior file or from a run, cannot be trained further at 1 mm."""
    first = training.PriorModule(NETWORK)
    options: dict[str, Any] = {"max_steps": 1, "logger": False, "enable_checkpointing": False}
    run = trainer(tmp_path, **options)
    run.fit(first, ValidatedByStacks())
    run.save_checkpoint(tmp_path / "run.ckpt")
    path = tmp_path / "prior.safetensors"
    assert first.voxel_mm is not None
    Prior(network=first.network, voxel_mm=first.voxel_mm, weeks=(30.0,), training_data="noise").save(path)
    data = ValidatedByStacks()
    data.spacing_mm = 1.0
    again = training.PriorModule(NETWORK, start_from=str(path))
    with pytest.raises(InputError, match=r"start_from: was trained on voxels of 0\.8 mm, the data have 1 mm"):
        trainer(tmp_path, **options).fit(again, data)
    run, fresh = lightning.Trainer(**{**options, "max_steps": 2}), training.PriorModule(NETWORK)
    with pytest.raises(InputError, match=r"ckpt_path: was trained on voxels of 0\.8 mm, the data have 1 mm"):
        run.fit(fresh, data, ckpt_path=tmp_path / "run.ckpt", weights_only=True)


def run_training(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "g3r.cli.pretrain", "fit", *TINY_TRAINING]
    command += [f"--trainer.logger.init_args.save_dir={folder}", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def steps_of(checkpoint: Path) -> int:
    return torch.load(checkpoint, map_location="cpu", weights_only=True)["global_step"]


@pytest.mark.slow
def test_training_goes_on_after_a_kill(tmp_path: Path) -> None:
    """The training is killed without warning after its second epoch at the earliest, and resumed for one more epoch."""
    process = run_training(tmp_path, "--trainer.max_epochs=1000")
    last = tmp_path / "prior" / "version_0" / "checkpoints" / "last.ckpt"
    deadline = time.monotonic() + 300
    while process.poll() is None and time.monotonic() < deadline:
        try:
            if last.exists() and steps_of(last) >= 4:
                break
        except (OSError, RuntimeError, EOFError):
            pass  # the file is being written
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    done = steps_of(last)  # complete, although its writer was killed
    assert done >= 4
    epochs = done // 2 + 1  # two steps per epoch
    resumed = run_training(tmp_path, f"--trainer.max_epochs={epochs}", f"--ckpt_path={last}")
    words, _ = resumed.communicate(timeout=300)
    assert resumed.returncode == 0, words[-2000:]
    (after,) = (tmp_path / "prior" / "version_1" / "checkpoints").glob("last*.ckpt")
    assert steps_of(after) == done + 2
    found = logged(tmp_path / "prior" / "version_1")
    assert min(event.step for event in found.Scalars("train/l1_prior")) >= done


@pytest.mark.slow
@pytest.mark.parametrize(
    "flags",
    [["--trainer.precision=bf16-mixed"], ["--trainer.devices=2", "--trainer.strategy=ddp"]],
    ids=["mixed precision", "two devices"],
)
def test_trainer_flags(tmp_path: Path, flags: list[str]) -> None:
    process = run_training(tmp_path, "--trainer.max_epochs=1", *flags)
    words, _ = process.communicate(timeout=400)
    assert process.returncode == 0, words[-2000:]
    (last,) = (tmp_path / "prior" / "version_0" / "checkpoints").glob("last*.ckpt")
    assert steps_of(last) > 0


@pytest.mark.slow
def test_another_anatomy_is_trained_with_the_same_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A folder of volumes with masks is enough for the prior; names need no age."""
    generator = np.random.default_rng(0)
    index = np.stack(np.meshgrid(*[np.arange(24)] * 3, indexing="ij"), -1) - 11.5
    mask = np.linalg.norm(index / [10, 8, 9], axis=-1) < 1
    for name in ("placenta-a", "placenta-b"):
        image = np.where(mask, 300 + 200 * gaussian_filter(generator.normal(size=mask.shape), 1.5), 0)
        (tmp_path / "atlas" / name).mkdir(parents=True)
        save_volume(tmp_path / "atlas" / name / "t2.nii.gz", image.astype(np.float32), np.diag([3.0, 3, 3, 1]))
        save_volume(tmp_path / "atlas" / name / "mask.nii.gz", mask, np.diag([3.0, 3, 3, 1]))
    process = run_training(tmp_path, "--trainer.max_epochs=1", f"--data.source={tmp_path / 'atlas'}")
    words, _ = process.communicate(timeout=400)
    assert process.returncode == 0, words[-2000:]
    (last,) = (tmp_path / "prior" / "version_0" / "checkpoints").glob("last*.ckpt")
    assert export.main([str(last), str(tmp_path / "prior.safetensors")]) == 0
    assert Prior.load(tmp_path / "prior.safetensors").voxel_mm == 3.0
    assert GaussianReconstructor(tmp_path / "prior.safetensors").networks.prior_voxel_mm == 3.0
