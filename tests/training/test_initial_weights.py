"""Initial weights from both kinds of file, under one policy for the three networks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("lightning.pytorch", reason="the training extra is not installed")

import lightning.pytorch as lightning

from g3r.cli import export
from g3r.errors import InputError
from g3r.prior.config import PriorNetworkConfig
from g3r.prior.dgpn import DensityGatedPriorNetwork
from g3r.prior.model import Prior
from g3r.training.annealed_module import AnnealedModule
from g3r.training.mask_module import MaskModule
from g3r.training.pose_module import PoseModule
from g3r.training.prior_module import PriorModule
from tests.training import test_mask_module as mask
from tests.training import test_pose_training as pose
from tests.training import test_prior_training as prior
from tests.training.small_runs import trainer
from tests.training.small_volumes import given_at_random

KINDS: dict[str, tuple[type[AnnealedModule], Any, type[lightning.LightningDataModule]]] = {
    "prior": (PriorModule, prior.NETWORK, prior.TinyData),
    "pose": (PoseModule, pose.NETWORK, pose.TinyData),
    "mask": (MaskModule, mask.NETWORK, mask.TinyData),
}


@pytest.fixture(scope="module", params=KINDS)
def files(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, Path]:
    """Kind of a network trained for one epoch, its checkpoint, and the file that is exported from it."""
    module_type, network, data = KINDS[request.param]
    folder = tmp_path_factory.mktemp(request.param)
    run = trainer(folder, max_epochs=1, logger=False, enable_checkpointing=False)
    run.fit(module_type(network=network, warmup_steps=1), data())  # type: ignore[call-arg]
    run.save_checkpoint(folder / "run.ckpt")
    assert export.main([str(folder / "run.ckpt"), str(folder / "run.safetensors")]) == 0
    return request.param, folder / "run.ckpt", folder / "run.safetensors"


def begun(kind: str, folder: Path, start: Path, network: Any = None) -> AnnealedModule:
    """A module that has taken its initial weights, and has not been trained."""
    module_type, usual, data = KINDS[kind]
    module = module_type(network=network or usual, start_from=str(start))  # type: ignore[call-arg]
    trainer(folder, logger=False).validate(module, data(), verbose=False)
    return module


@pytest.mark.parametrize("exported", [False, True])
def test_weights_of_both_kinds_of_file_are_taken(files: tuple[str, Path, Path], exported: bool, tmp_path: Path) -> None:
    kind, checkpoint, file = files
    found = begun(kind, tmp_path, file if exported else checkpoint).network.state_dict()
    content = torch.load(checkpoint, weights_only=True)["state_dict"]
    for name, value in content.items():
        if name.startswith("network.") and "num_batches_tracked" not in name:
            # exported weights of pose and mask network are float16
            torch.testing.assert_close(found[name.removeprefix("network.")], value, atol=1e-3, rtol=1e-3, msg=name)


def test_another_size_another_kind_and_no_file_are_refused(files: tuple[str, Path, Path], tmp_path: Path) -> None:
    kind, checkpoint, file = files
    channels = tuple(2 * n for n in KINDS[kind][1].channels)
    other = "mask" if kind == "prior" else "prior"
    for path in (checkpoint, file):
        with pytest.raises(InputError, match=r"^model.start_from: .* holds .*Config\(.* same size and inputs"):
            begun(kind, tmp_path, path, network=replace(KINDS[kind][1], channels=channels))
        with pytest.raises(InputError, match=rf"^model.start_from: .*{kind}.* expected .*{other}"):
            begun(other, tmp_path, path)
        with pytest.raises(InputError, match=r"^model.start_from: .*none"):
            begun(kind, tmp_path, path.with_stem("none"))


def test_a_run_goes_on_without_the_file_that_it_began_with(files: tuple[str, Path, Path], tmp_path: Path) -> None:
    kind, checkpoint, _ = files
    module_type, network, data = KINDS[kind]
    gone = tmp_path / "gone.ckpt"
    module = module_type(network=network, start_from=str(gone))  # type: ignore[call-arg]
    run = trainer(tmp_path, max_epochs=2, logger=False, enable_checkpointing=False)
    run.fit(module, data(), ckpt_path=checkpoint, weights_only=True)
    assert run.current_epoch == 2
    trained = {name: value.clone() for name, value in module.state_dict().items()}
    run.validate(module, data(), verbose=False)  # nor is it looked for later
    for name, value in module.state_dict().items():
        assert torch.equal(value, trained[name]), name
    assert module.hparams["start_from"] == str(gone)


def test_weights_are_taken_once(files: tuple[str, Path, Path], tmp_path: Path) -> None:
    """A validation after a training sets the module up again."""
    kind, checkpoint, _ = files
    module = begun(kind, tmp_path, checkpoint)
    with torch.no_grad():
        for value in module.network.parameters():
            value.add_(1.0)
    first = next(iter(module.network.parameters())).clone()
    trainer(tmp_path, logger=False).validate(module, KINDS[kind][2](), verbose=False)
    assert torch.equal(next(iter(module.network.parameters())), first)


@pytest.mark.parametrize("use_template", [False, True])
def test_beginning_with_the_weights_of_another_prior(tmp_path: Path, use_template: bool) -> None:
    """With another base the residual starts at zero; the template is that of the data, not of the file."""
    torch.manual_seed(0)
    old = DensityGatedPriorNetwork(replace(prior.NETWORK, use_template=use_template))
    torch.nn.init.normal_(old.refiner.head.weight)
    path = tmp_path / "old.safetensors"
    old.set_template(torch.rand(3, 2, 2, 2))  # another shape, which must not be taken
    Prior(network=old, voxel_mm=0.8, weeks=(25.0, 28.0, 31.0), training_data="noise").save(path)
    given = given_at_random(8, 8, 8)

    def begun(config: PriorNetworkConfig) -> DensityGatedPriorNetwork:
        module = PriorModule(config)
        module.begin_with(str(path))
        return module.network

    new = begun(prior.NETWORK)
    assert new.config.template_shape == prior.NETWORK.template_shape
    if use_template:
        for one, other in zip(new(given), old(given), strict=True):
            torch.testing.assert_close(one, other)
    else:
        torch.testing.assert_close(new(given).volume, given.base(prior.NETWORK))
        # channels that the file lacks start without effect
        shown = replace(given, template=torch.rand(1, 1, 8, 8, 8))
        new.refiner.head.load_state_dict(old.refiner.head.state_dict())
        torch.testing.assert_close(new.refiner(shown)[0], old.refiner(given)[0])
    moved_base = replace(prior.NETWORK, sharp_base=True)
    moved = begun(moved_base)
    torch.testing.assert_close(moved(given).volume, given.base(moved_base))
    for config in (replace(prior.NETWORK, use_sharp=False), replace(prior.NETWORK, use_density=False)):
        with pytest.raises(InputError, match=r"model\.start_from: .* same size and inputs"):
            begun(config)
    with pytest.raises(InputError, match=r"model\.start_from: .* same size and inputs"):
        begun(replace(prior.NETWORK, channels=(8, 16)))
