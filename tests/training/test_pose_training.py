"""Training of the pose network, its logs, and export."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation

from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.checkpoints.plain_values import config_from_plain
from g3r.cli import export, pretrain
from g3r.errors import InputError
from g3r.pose_network.config import PoseNetworkConfig
from g3r.pose_network.model import PoseModel

pytest.importorskip("lightning.pytorch", reason="the training extra is not installed")

import lightning.pytorch as lightning
from torch.utils.data import DataLoader

from g3r.pose_network.inference import as_pose
from g3r.pose_network.network import PoseStep
from g3r.training.pose_module import PoseModule, disturbed, point_loss, vote_loss
from g3r.training.pose_scores import scores_of, summary
from tests.training.small_runs import assert_export_refuses, assert_resuming_changes_nothing, in_memory, logged, trainer

NETWORK = PoseNetworkConfig(channels=(4, 8, 8), width=32, n_blocks=2, n_heads=2)
SMALL: dict[str, Any] = {"network": NETWORK, "warmup_steps": 1}
CONFIG = "lightning_configs/pose.yaml"
Trained = tuple[Path, Path, PoseModule]


def sample(seed: int, n_stacks: int = 2, n_slices: int = 5) -> dict[str, torch.Tensor]:
    """Slices of one head: noise images with consistent poses."""
    rng = np.random.default_rng(seed)
    stack = np.repeat(np.arange(n_stacks), n_slices)
    header = Rotation.random(n_stacks, random_state=seed).as_matrix()[stack]
    position = np.tile(np.linspace(-30, 30, n_slices), n_stacks)
    turn = Rotation.random(random_state=seed + 100).as_matrix()
    true = turn @ header
    arrays = {
        "image": rng.random((len(stack), 1, 40, 40)),
        "area_mm2": np.full(len(stack), 2000.0),
        "position_mm": position,
        "thickness_mm": np.full(len(stack), 3.0),
        "time_rank": np.full(len(stack), np.nan),
        "header_rotation": header,
        "true_rotation": true,
        "true_translation_mm": true[:, :, 2] * position[:, None],
    }
    batch = {name: torch.from_numpy(value.astype(np.float32)) for name, value in arrays.items()}
    return batch | {"stack": torch.from_numpy(stack), "set_of_stack": torch.zeros(n_stacks, dtype=torch.long)}


class TinyData(lightning.LightningDataModule):
    """A few heads in memory, and a template of two ages."""

    def __init__(
        self, n_ages: int = 2, pixel_mm: float = 3.0, template_mm: float = 3.0, source: str = "/some/where/atlas"
    ) -> None:
        super().__init__()
        self.save_hyperparameters()

    def template(self) -> AtlasTemplate:
        shape = (self.hparams["n_ages"], 9, 10, 11)
        config = PoseNetworkConfig(template_shape=shape, template_spacing_mm=self.hparams["template_mm"])
        heads = np.random.default_rng(0).random(shape).astype(np.float32)
        return AtlasTemplate(heads, config.template_grid.affine, np.arange(25.0, 25.0 + shape[0]))

    def train_dataloader(self) -> DataLoader:
        return in_memory([sample(seed) for seed in range(3)])

    def val_dataloader(self) -> DataLoader:
        return in_memory([sample(8, n_stacks=1), sample(9, n_stacks=2)])


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """A run of one epoch: its folder, its checkpoint, its module."""
    folder = tmp_path_factory.mktemp("training")
    torch.manual_seed(0)
    module = PoseModule(**SMALL)
    run = trainer(folder, max_epochs=1)
    run.fit(module, TinyData())
    run.save_checkpoint(folder / "last.ckpt")
    return folder, folder / "last.ckpt", module


def test_tensorboard_has_scalars_and_the_panel(trained: Trained) -> None:
    log = logged(trained[0] / "run" / "version_0")
    scores = {"val/slice_mm", "val/slice_deg", "val/stack_deg", "val/stacks_within_20deg", "val/stack_mm_1"}
    train = {"train/mm_step0", "train/mm_step1", "train/vote_step0", "train/samples_per_second"}
    assert scores | train <= set(log.Tags()["scalars"])
    assert len(log.Tags()["images"]) == 1


def test_the_template_is_the_data_module_s(trained: Trained) -> None:
    heads = torch.from_numpy(TinyData().template().volume)
    torch.testing.assert_close(trained[2].network.template.permute(3, 0, 1, 2), heads)
    assert trained[2].weeks == [25.0, 26.0]


@pytest.mark.filterwarnings("ignore:Checkpoint directory")  # the resumed run writes to the same folder
def test_resuming_goes_on_as_if_nothing_had_happened(tmp_path: Path) -> None:
    """This includes the same random disturbances of the poses."""
    assert_resuming_changes_nothing(lambda: PoseModule(**SMALL), TinyData, tmp_path)


def test_export_gives_the_same_network(trained: Trained, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, checkpoint, module = trained
    path = tmp_path / "pose.safetensors"
    assert export.main([str(checkpoint), str(path)]) == 0
    model = PoseModel.load(path)
    batch = sample(5)
    with torch.no_grad():
        torch.testing.assert_close(
            model.network(batch)[-1].translation_mm, module.network.eval()(batch)[-1].translation_mm, rtol=0, atol=0.1
        )  # float16
    assert model.template.weeks.tolist() == [25, 26]
    assert "TinyData(n_ages=2, pixel_mm=3.0, template_mm=3.0, source=atlas)" in model.training_data
    assert "/some/where" not in model.training_data
    assert model.validation["val/slice_mm"] > 0
    assert "val/slice_mm" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("alter", "expected"),
    [
        (lambda content: content.pop("g3r_export"), "is no checkpoint of g3r-pretrain"),
        (lambda content: content["g3r_export"].update(weeks=[25.0]), "cannot be used"),
        (lambda content: content["g3r_export"].update(kind="mask"), "cannot be used"),
        (lambda content: content["state_dict"].popitem(), "cannot be used"),
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


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"template_mm": 4.0}, "not on a grid of 3 mm"), ({"pixel_mm": 4.0}, "data.pixel_mm: 4.0")],
)
def test_data_that_do_not_fit(tmp_path: Path, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        trainer(tmp_path, max_epochs=1).fit(PoseModule(**SMALL), TinyData(**settings))


def test_resuming_with_another_template_is_refused(trained: Trained, tmp_path: Path) -> None:
    module = PoseModule(**SMALL)
    with pytest.raises(InputError, match=r"template_shape .* resume with the same data"):
        trainer(tmp_path, max_epochs=2).fit(module, TinyData(n_ages=3), ckpt_path=trained[1], weights_only=True)


def exact_step(batch: dict[str, torch.Tensor]) -> PoseStep:
    return PoseStep(batch["true_rotation"], batch["true_translation_mm"], batch["true_rotation"])


def test_losses_and_scores_of_true_poses() -> None:
    batch = sample(0)
    step = exact_step(batch)
    assert float(point_loss(step, batch)) == pytest.approx(0.01)  # the softening of the square root
    assert float(vote_loss(step, batch)) == 0.0
    true = as_pose(step.rotation, step.translation_mm)
    scores = summary([scores_of(true, true, batch)])
    assert scores["slice_mm"] < 1e-3
    assert scores["stack_deg_2"] < 1e-2
    assert scores["stacks_within_20deg"] == 1.0


def test_loss_is_a_distance_in_mm() -> None:
    batch = sample(0)
    off = exact_step(batch)._replace(translation_mm=batch["true_translation_mm"] + torch.tensor([3.0, 4, 0]))
    assert float(point_loss(off, batch)) == pytest.approx(5.0, abs=1e-3)


def test_disturbed_poses_stay_rigid_and_some_heads_stay_as_they_are() -> None:
    torch.manual_seed(1)
    n_heads, per_stack = 40, 3
    set_of_stack = torch.arange(n_heads).repeat_interleave(2)
    stack = torch.arange(2 * n_heads).repeat_interleave(per_stack)
    rotation = torch.eye(3).expand(len(stack), 3, 3)
    turned, moved = disturbed(rotation, torch.zeros(len(stack), 3), stack, set_of_stack)
    torch.testing.assert_close(turned @ turned.transpose(1, 2), rotation, atol=1e-5, rtol=0)
    changed = (moved.abs().sum(1) > 0).reshape(n_heads, -1)
    assert (changed.all(1) | ~changed.any(1)).all()
    assert 5 < changed.all(1).sum() < n_heads - 5


def test_the_configuration_fits(pytestconfig: pytest.Config) -> None:
    config = yaml.safe_load((pytestconfig.rootpath / CONFIG).read_text())
    assert config["model"]["class_path"] == f"{PoseModule.__module__}.{PoseModule.__qualname__}"
    arguments = config["model"]["init_args"]
    PoseModule(config_from_plain(PoseNetworkConfig, asdict(NETWORK) | arguments.pop("network")), **arguments)
    from data_synth.pose_data import SliceSetDataModule

    SliceSetDataModule(**config["data"]["init_args"])


@pytest.mark.parametrize(("config", "setting"), [("pose", "width"), ("prior", "alpha")])
def test_one_command_trains_both(
    pytestconfig: pytest.Config, capsys: pytest.CaptureFixture[str], config: str, setting: str
) -> None:
    """The settings are read and printed."""
    path = pytestconfig.rootpath / "lightning_configs" / f"{config}.yaml"
    with pytest.raises(SystemExit) as done:
        pretrain.main(["fit", "--config", str(path), f"--model.network.{setting}", "64", "--print_config"])
    assert done.value.code == 0
    shown = yaml.safe_load(capsys.readouterr().out)
    network = shown["model"]["init_args"]["network"]
    assert network[setting] == 64
    assert network["channels"] == {"pose": [24, 48, 96], "prior": [32, 64, 96]}[config]  # the rest is unchanged


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # raised inside jsonargparse
def test_weights_that_cannot_be_started_from_are_refused_in_one_line(
    pytestconfig: pytest.Config, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """jsonargparse wraps the error of the model in its own."""
    path = pytestconfig.rootpath / "lightning_configs" / "prior.yaml"
    file = tmp_path / "prior.safetensors"
    file.write_bytes(b"not weights")
    code = pretrain.main(["fit", "--config", str(path), f"--model.start_from={file}"])
    assert code == InputError.exit_code
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("g3r-pretrain: ")]
    assert str(file) in line
