"""Training of the mask network, its logs, and export."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import yaml

from g3r.cli import export, pretrain
from g3r.errors import InputError
from g3r.mask_network.config import MaskNetworkConfig
from g3r.mask_network.model import MaskModel
from g3r.prior.model import Prior

pytest.importorskip("lightning.pytorch", reason="the training extra is not installed")

import lightning.pytorch as lightning
from torch.utils.data import DataLoader

from g3r.training.mask_module import MaskModule, dice, scores_of, summary
from tests.training.small_runs import assert_resuming_changes_nothing, in_memory, logged, trainer

NETWORK = MaskNetworkConfig(channels=(4, 8))


def sample(seed: int, *, head: bool = True) -> dict[str, torch.Tensor]:
    """A bright ball in noise."""
    generator = torch.Generator().manual_seed(seed)
    made = {}
    for name, shape in {"wide_": (32, 32, 6), "": (48, 48, 6)}.items():
        at = torch.stack(torch.meshgrid(*(torch.arange(n) - n / 2 for n in shape), indexing="ij"), -1)
        mask = ((at - torch.tensor([2.0, -3.0, 0.0])).norm(dim=-1) < shape[0] / 3).float() * head
        image = 0.3 * torch.rand(shape, generator=generator) + 0.7 * mask
        made[f"{name}image"], made[f"{name}mask"] = image[None, None], mask[None, None]
    return made


class TinyData(lightning.LightningDataModule):
    """A few stacks in memory."""

    def __init__(self, wide_mm: float = 2.4, pixel_mm: float = 1.2, source: str = "/some/where/atlas") -> None:
        super().__init__()
        self.save_hyperparameters()

    def train_dataloader(self) -> DataLoader:
        return in_memory([sample(seed) for seed in range(4)])

    def val_dataloader(self) -> DataLoader:
        return in_memory([sample(8), sample(9, head=False)])


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, MaskModule]:
    """A run, its folder and its checkpoint."""
    folder = tmp_path_factory.mktemp("mask")
    lightning.seed_everything(1)
    module = MaskModule(network=NETWORK, warmup_steps=1, learning_rate=1e-2)
    run = trainer(folder, max_epochs=30, check_val_every_n_epoch=15)
    run.fit(module, datamodule=TinyData())
    path = folder / "run.ckpt"
    run.save_checkpoint(path)
    return folder, path, module


def test_the_loss_falls(trained: tuple[Path, Path, MaskModule]) -> None:
    board = logged(trained[0] / "run" / "version_0")
    for name in ("train/find_loss", "train/outline_loss"):
        values = [point.value for point in board.Scalars(name)]
        assert values[-1] < 0.6 * values[0], name
    names = set(board.Tags()["scalars"])
    assert {"val/outline_dice", "val/find_dice", "val/false_find_cm2", "train/samples_per_second"} <= names
    assert board.Tags()["images"]


@pytest.mark.filterwarnings("ignore:Checkpoint directory")  # the resumed run writes to the same folder
def test_resuming_goes_on_as_if_nothing_had_happened(tmp_path: Path) -> None:
    assert_resuming_changes_nothing(lambda: MaskModule(network=NETWORK, warmup_steps=1), TinyData, tmp_path)


def test_export_and_load(trained: tuple[Path, Path, MaskModule], tmp_path: Path) -> None:
    _, checkpoint, module = trained
    file = tmp_path / "mask.safetensors"
    assert export.main([str(checkpoint), str(file)]) == 0
    model = MaskModel.load(file)
    assert model.network.config == NETWORK
    assert "atlas" in model.training_data
    assert "/some" not in model.training_data
    image = sample(3)["image"]
    module.eval()
    with torch.inference_mode():
        torch.testing.assert_close(
            torch.sigmoid(model.network(image)), torch.sigmoid(module.network(image)), atol=0.02, rtol=0
        )
    with pytest.raises(InputError, match="not a prior checkpoint"):
        Prior.load(file)


def test_data_of_another_resolution_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"data\.pixel_mm: 2\.0"):
        trainer(tmp_path, max_epochs=1).fit(MaskModule(network=NETWORK), datamodule=TinyData(pixel_mm=2.0))


def test_scores_are_dice_with_a_head_and_false_area_without() -> None:
    batch = sample(1)
    config = MaskNetworkConfig(wide_mm=4.0, pixel_mm=4.0)
    assert scores_of(batch["wide_mask"], batch["mask"], batch, config) == {"find_dice": 1.0, "outline_dice": 1.0}
    none = sample(1, head=False)
    assert scores_of(none["wide_mask"], none["mask"], none, config) == {"false_find_cm2": 0.0, "false_outline_cm2": 0.0}
    false = scores_of(batch["wide_mask"], batch["mask"], none, config)
    assert false["false_find_cm2"] == pytest.approx(float(batch["wide_mask"].sum()) * 0.16)
    assert summary([{"find_dice": 1.0}, {"find_dice": 0.5}, false])["find_dice"] == 0.75
    assert dice(torch.tensor([True, False]), torch.tensor([True, True])) == pytest.approx(2 / 3)


def test_impossible_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="wide_weight"):
        MaskModule(network=NETWORK, wide_weight=0.0)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # raised inside jsonargparse
def test_the_command_reads_the_config(pytestconfig: pytest.Config, capsys: pytest.CaptureFixture[str]) -> None:
    """The settings are read and printed, and the data module accepts them."""
    path = pytestconfig.rootpath / "lightning_configs" / "mask.yaml"
    with pytest.raises(SystemExit) as done:
        pretrain.main(["fit", "--config", str(path), "--model.network.wide_mm", "5", "--print_config"])
    assert done.value.code == 0
    shown = yaml.safe_load(capsys.readouterr().out)
    network = shown["model"]["init_args"]["network"]
    assert network["wide_mm"] == 5
    assert network["channels"] == [24, 48, 96, 128]  # the other settings are unchanged
    from data_synth.mask_data import MaskDataModule

    MaskDataModule(**shown["data"]["init_args"])
