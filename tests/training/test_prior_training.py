"""Training of the prior network, its logs, and export."""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.checkpoints.plain_values import config_from_plain
from g3r.cli import export
from g3r.errors import InputError
from g3r.prior.config import PriorNetworkConfig
from g3r.prior.model import Prior

pytest.importorskip("lightning.pytorch", reason="the training extra is not installed")

import lightning.pytorch as lightning
from torch.utils.data import DataLoader

from g3r.training import prior_batches as batches
from g3r.training import prior_module as training
from g3r.training.annealed_module import cosine_factor
from g3r.training.prior_validation import PLACES
from tests.training.small_runs import assert_export_refuses, assert_resuming_changes_nothing, in_memory, logged, trainer
from tests.training.small_volumes import given_at_random, sample

NETWORK = PriorNetworkConfig(channels=(8, 8), units=(1, 1), tail_channels=4, template_spacing_mm=4.0)
SMALL: dict[str, Any] = {"network": NETWORK, "warmup_steps": 1}
CONFIG = "lightning_configs/prior.yaml"
Trained = tuple[Path, Path, training.PriorModule]


class TinyData(lightning.LightningDataModule):
    """Four samples in memory, and a template of two ages."""

    def __init__(self, spacing_mm: float = 0.8, template_mm: float = 4.0, source: str = "/some/where/atlas") -> None:
        super().__init__()
        self.save_hyperparameters()

    def template(self) -> AtlasTemplate:
        config = replace(NETWORK, template_shape=(2, 5, 6, 4), template_spacing_mm=self.hparams["template_mm"])
        heads = np.random.default_rng(0).random(config.template_shape).astype(np.float32)
        return AtlasTemplate(heads, config.template_grid.affine, np.array([25.0, 31.0]))

    def train_dataloader(self) -> DataLoader:
        return in_memory([sample(seed) for seed in range(4)], 2)

    def val_dataloader(self) -> DataLoader:
        return in_memory([sample(seed) for seed in (8, 9)], 2)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """A run of two steps: its folder, its checkpoint, its module."""
    folder = tmp_path_factory.mktemp("training")
    torch.manual_seed(0)
    module = training.PriorModule(replace(NETWORK, alpha=0.1), warmup_steps=1)
    run = trainer(folder, max_steps=2)
    run.fit(module, TinyData())
    run.save_checkpoint(folder / "last.ckpt")
    return folder, folder / "last.ckpt", module


def test_tensorboard_has_scalars_and_the_panel(trained: Trained) -> None:
    log = logged(trained[0] / "run" / "version_0")
    scores = {
        f"val/{metric}_{name}" for metric in ("l1", "psnr", "ssim") for name in ("prior", "sharp", "coarse", "template")
    }
    by_confidence = {f"train/l1_prior_{name}" for name in ("hardly_seen", "thinly_seen", "seen")}
    by_place = {f"val/psnr_prior_seen_{place}" for place in PLACES}
    speed = {"train/samples_per_second", "train/waiting_for_data"}
    losses = {"train/loss", "train/l1_prior", "train/l1_coarse"}
    assert scores | speed | losses | by_confidence | by_place <= set(log.Tags()["scalars"])
    (tag,) = log.Tags()["images"]
    image = log.Images(tag)[0]
    assert (image.height, image.width) == (16, 8 * 16)


def test_training_moves_the_weights(trained: Trained) -> None:
    assert float(trained[2].network.refiner.head.weight.detach().abs().max()) > 0


@pytest.mark.filterwarnings("ignore:Checkpoint directory")  # the resumed run writes to the same folder
def test_resuming_goes_on_as_if_nothing_had_happened(tmp_path: Path) -> None:
    assert_resuming_changes_nothing(lambda: training.PriorModule(**SMALL), TinyData, tmp_path)


def test_export_gives_the_same_network(trained: Trained, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, checkpoint, module = trained
    path = tmp_path / "prior.safetensors"
    assert export.main([str(checkpoint), str(path)]) == 0
    prior = Prior.load(path)
    given = given_at_random(12, 16, 9)
    with torch.no_grad():
        for one, other in zip(prior.network(given), module.eval()(given), strict=True):
            torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)
    assert (prior.network.config.alpha, prior.voxel_mm) == (0.1, 0.8)
    assert prior.template.weeks.tolist() == [25, 31]
    np.testing.assert_allclose(prior.template.volume, TinyData().template().volume, atol=1e-3)  # float16
    np.testing.assert_allclose(prior.template.affine, TinyData().template().affine)
    assert "TinyData(spacing_mm=0.8, template_mm=4.0, source=atlas)" in prior.training_data
    assert "/some/where" not in prior.training_data
    assert prior.validation["val/psnr_prior"] > 0
    assert "val/psnr_prior" in capsys.readouterr().out


def test_export_does_not_overwrite_unless_told(
    trained: Trained, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "prior.safetensors"
    path.write_text("precious")
    assert export.main([str(trained[1]), str(path)]) == 3
    assert capsys.readouterr().err.count("\n") == 1
    assert path.read_text() == "precious"
    assert export.main([str(trained[1]), str(path), "--force", "--data-description", "three heads"]) == 0
    assert Prior.load(path).training_data == "three heads"


def without(*keys: str) -> Callable[[dict[str, Any]], object]:
    return lambda content: [content.pop(key) for key in keys]


def spoil(content: dict[str, Any]) -> None:
    content["state_dict"]["network.refiner.head.weight"][0, 0, 0, 0, 0] = np.inf


@pytest.mark.parametrize(
    ("alter", "expected"),
    [
        (without("g3r_export"), "is no checkpoint of g3r-pretrain"),
        (without("state_dict"), "is no checkpoint of g3r-pretrain"),
        (lambda content: content["g3r_export"].update(voxel_mm=None), "cannot be used"),
        (lambda content: content["g3r_export"].update(voxel_mm=1e3), "voxel size is 1000.0 mm"),
        (lambda content: content["g3r_export"].update(weeks=[25.0]), "1 ages for a template of 2"),
        (lambda content: content["state_dict"].popitem(), "cannot be used"),
        (spoil, "NaN or infinity"),
        (lambda content: content["g3r_export"].update(kind="liver"), "kind 'liver'; expected one of prior, pose, mask"),
        (
            lambda content: content["g3r_export"]["conventions"].update(density_convention="old"),
            "its density convention is 'old' (trained by g3r",
        ),
        # of versions that did not record them
        (lambda content: content["g3r_export"].pop("conventions"), "is not recorded (trained by g3r"),
    ],
)
def test_export_refuses(
    trained: Trained,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    alter: Callable[[dict[str, Any]], object],
    expected: str,
) -> None:
    assert_export_refuses(trained[1], alter, expected, tmp_path, capsys)


def test_export_wants_the_ending_of_its_format(
    trained: Trained, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export.main([str(trained[1]), str(tmp_path / "prior.pt")]) == 3
    assert "expected a name that ends in .safetensors" in capsys.readouterr().err
    assert not (tmp_path / "prior.pt").exists()


def test_a_network_of_another_density_is_for_comparison_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """g3r-infer would give such a network the wrong density, that of whole slices."""
    module = training.PriorModule(**SMALL, density="masked")
    done = trainer(tmp_path, max_steps=1)
    done.fit(module, TinyData())
    done.save_checkpoint(tmp_path / "run.ckpt")
    assert export.main([str(tmp_path / "run.ckpt"), str(tmp_path / "prior.safetensors")]) == 3
    assert "was trained with --model.density=masked, for comparison only" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"ckpt_path: was trained with --model\.density=masked, now it is .*coverage"):
        trainer(tmp_path, max_steps=2).fit(
            training.PriorModule(**SMALL), TinyData(), ckpt_path=tmp_path / "run.ckpt", weights_only=True
        )
    with pytest.raises(ValueError, match="expected one of coverage, masked, printed"):
        training.PriorModule(**SMALL, density="other")


@pytest.mark.parametrize("content", [None, "text\n"])
def test_export_refuses_what_is_no_checkpoint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str | None
) -> None:
    if content is not None:
        (tmp_path / "run.ckpt").write_text(content)
    assert export.main([str(tmp_path / "run.ckpt"), str(tmp_path / "prior.safetensors")]) == 3
    assert capsys.readouterr().err.count("\n") == 1


def test_a_checkpoint_can_be_validated_by_itself(trained: Trained, tmp_path: Path) -> None:
    """As the model card does; nothing is fitted, and the weights are those of the file."""
    _, checkpoint, module = trained
    torch.manual_seed(1)
    fresh = training.PriorModule(replace(NETWORK, alpha=0.1))
    (scores,) = trainer(tmp_path, logger=False).validate(fresh, TinyData(), ckpt_path=checkpoint, verbose=False)
    (of_trained,) = trainer(tmp_path, logger=False).validate(module, TinyData(), verbose=False)
    assert scores["val/psnr_prior"] == pytest.approx(of_trained["val/psnr_prior"])
    assert fresh.voxel_mm == 0.8


def test_voxel_size_must_agree_with_the_data(tmp_path: Path) -> None:
    module = training.PriorModule(**SMALL, voxel_mm=1.0)
    with pytest.raises(InputError, match=r"1.0 mm, but the data are made at 0.8 mm"):
        trainer(tmp_path, max_steps=2).fit(module, TinyData())


def test_the_template_s_voxels_must_agree_with_the_data(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"not on a grid of 4 mm.*template_spacing_mm"):
        trainer(tmp_path, max_steps=2).fit(training.PriorModule(**SMALL), TinyData(template_mm=3.0))


def test_a_patch_can_be_learnt() -> None:
    """Sixty steps on one patch reduce the prior's error to half that of V_coarse."""
    torch.manual_seed(0)
    module = training.PriorModule(**SMALL, learning_rate=3e-3)
    batch = {name: value[None] for name, value in sample(0, size=24).items()}
    weight = batches.loss_weight(batch, 0.1)
    optimizer = torch.optim.AdamW(module.parameters(), lr=3e-3)
    for _ in range(60):
        found = module(batches.prior_inputs(batch))
        optimizer.zero_grad()
        batches.prior_loss(found, batch, weight).backward()
        optimizer.step()
    loss, coarse_loss = (
        batches.weighted_l1(volume, batch["truth"], weight) for volume in (found.volume, batch["coarse"])
    )
    assert loss.item() < 0.5 * coarse_loss.item(), (loss.item(), coarse_loss.item())


def test_learning_rate_follows_the_budget_that_ends_first(tmp_path: Path) -> None:
    """With many steps left but no time, the rate is at its final value."""
    module = training.PriorModule(**SMALL)
    run = trainer(tmp_path, max_steps=-1, max_epochs=10_000, max_time=timedelta(seconds=2))
    run.fit(module, TinyData())
    (optimizer,) = run.optimizers
    assert optimizer.param_groups[0]["lr"] < 0.05 * module.learning_rate


def test_cosine_factor() -> None:
    values = [cosine_factor(progress) for progress in (-1, 0, 0.5, 1, 7)]
    assert values == pytest.approx([1, 1, 0.505, 0.01, 0.01])


def test_the_configuration_fits_the_module(pytestconfig: pytest.Config) -> None:
    config = yaml.safe_load((pytestconfig.rootpath / CONFIG).read_text())
    assert config["model"]["class_path"] == f"{training.PriorModule.__module__}.PriorModule"
    arguments = config["model"]["init_args"]
    network = config_from_plain(PriorNetworkConfig, asdict(NETWORK) | arguments.pop("network"))
    assert training.PriorModule(network, **arguments).network.config.alpha == 0.5


@pytest.mark.parametrize("command", ["pretrain", "export"])
def test_help_is_quick(command: str) -> None:
    code = (
        f"import sys\nfrom g3r.cli import {command}\n"
        f"try: {command}.main(['--help'])\nexcept SystemExit as done: assert done.code == 0\n"
        "assert not {'torch', 'monai', 'lightning'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "usage:" in done.stdout
