"""Going on from a checkpoint: the command line counts, other networks are refused, steps draw their own numbers."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("lightning.pytorch", reason="the training extra is not installed")

import lightning.pytorch as lightning

from g3r.cli import pretrain
from g3r.errors import InputError
from g3r.training.mask_module import Batch, MaskModule
from g3r.training.prior_module import PriorModule
from tests.training import test_prior_training as prior
from tests.training.small_runs import trainer
from tests.training.test_mask_module import NETWORK, TinyData

FIT: dict[str, Any] = {"logger": False, "enable_checkpointing": False}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mask network after one epoch at a rate of 1e-3."""
    folder = tmp_path_factory.mktemp("begun")
    run = trainer(folder, max_epochs=1, **FIT)
    run.fit(MaskModule(network=NETWORK, learning_rate=1e-3, warmup_steps=0), TinyData())
    run.save_checkpoint(folder / "run.ckpt")
    return folder / "run.ckpt"


def resumed(folder: Path, checkpoint: Path, module: MaskModule) -> lightning.Trainer:
    run = trainer(folder, max_epochs=2, **FIT)
    run.fit(module, TinyData(), ckpt_path=checkpoint, weights_only=True)
    return run


def test_another_network_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    other = MaskModule(network=replace(NETWORK, channels=(4, 16)))
    with pytest.raises(InputError, match=r"^ckpt_path: its network has .*, this one has .*--model\.network"):
        resumed(tmp_path, checkpoint, other)


def altered(checkpoint: Path, folder: Path, alter: Callable[[dict[str, Any]], object]) -> Path:
    content = torch.load(checkpoint, weights_only=True)
    alter(content)
    torch.save(content, folder / "altered.ckpt")
    return folder / "altered.ckpt"


def test_another_kind_and_another_program_are_refused(checkpoint: Path, tmp_path: Path) -> None:
    without = altered(checkpoint, tmp_path, lambda content: content.pop("g3r_export"))
    with pytest.raises(InputError, match="ckpt_path: is of another program"):
        resumed(tmp_path, without, MaskModule(network=NETWORK))
    with pytest.raises(InputError, match=r"ckpt_path: is of a mask network; .* of a prior network"):
        trainer(tmp_path, max_steps=2, **FIT).fit(
            PriorModule(**prior.SMALL), prior.TinyData(), ckpt_path=checkpoint, weights_only=True
        )


def test_other_conventions_are_refused(tmp_path: Path) -> None:
    run = trainer(tmp_path, max_steps=1, **FIT)
    run.fit(PriorModule(**prior.SMALL), prior.TinyData())
    run.save_checkpoint(tmp_path / "run.ckpt")
    changed = altered(
        tmp_path / "run.ckpt", tmp_path, lambda c: c["g3r_export"]["conventions"].update(sharp_convention="of old")
    )
    with pytest.raises(InputError, match="ckpt_path: its sharp convention is 'of old'"):
        trainer(tmp_path, max_steps=2, **FIT).fit(
            PriorModule(**prior.SMALL), prior.TinyData(), ckpt_path=changed, weights_only=True
        )


def said(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [one.getMessage() for one in caplog.records if one.name.startswith("g3r.")]


def test_the_rates_of_now_hold(checkpoint: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Lightning restores the optimiser with the rates of the checkpoint."""
    same = resumed(tmp_path, checkpoint, MaskModule(network=NETWORK, learning_rate=1e-3, warmup_steps=0))
    assert not said(caplog)
    with caplog.at_level(logging.WARNING, "g3r.training.resumption"):
        module = MaskModule(network=NETWORK, learning_rate=1e-4, weight_decay=0.5, warmup_steps=0)
        other = resumed(tmp_path, checkpoint, module)
    (group,), (as_before,) = other.optimizers[0].param_groups, same.optimizers[0].param_groups
    assert group["lr"] == pytest.approx(0.1 * as_before["lr"])
    assert (group["initial_lr"], group["weight_decay"]) == (1e-4, 0.5)
    assert said(caplog) == [
        "model.learning_rate: 0.001 in ckpt_path; 0.0001 holds from here on",
        "model.weight_decay: 0.0001 in ckpt_path; 0.5 holds from here on",
    ]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # raised inside jsonargparse
def test_options_of_the_command_count_on_resuming(
    checkpoint: Path, tmp_path: Path, pytestconfig: pytest.Config, capsys: pytest.CaptureFixture[str]
) -> None:
    """Lightning's command would lay the settings in the checkpoint over them."""
    command = ["validate", "--config", str(pytestconfig.rootpath / "lightning_configs" / "mask.yaml")]
    command += [f"--trainer.logger.init_args.save_dir={tmp_path}", "--data.num_workers=0", "--trainer.accelerator=cpu"]
    command += ["--model.network.channels=[4,16]", f"--ckpt_path={checkpoint}"]
    assert pretrain.main(command) == InputError.exit_code
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("g3r-pretrain: ")]
    assert "its network has channels (4, 8), this one has channels (4, 16)" in line


class NotedModule(MaskModule):
    """Keeps the first random number of every batch, by step."""

    drawn: dict[int, list[int]]

    def training_step(self, batch: Batch, batch_idx: int) -> torch.Tensor:
        self.drawn.setdefault(self.global_step, []).append(int(torch.randint(2**40, ())))
        return super().training_step(batch, batch_idx)


def drawn(folder: Path, monkeypatch: pytest.MonkeyPatch, **options: Any) -> dict[int, list[int]]:
    monkeypatch.setenv("PL_GLOBAL_SEED", "7")
    module = NotedModule(network=NETWORK)
    module.drawn = {}
    trainer(folder, max_epochs=1, **FIT, **options).fit(module, TinyData())
    return module.drawn


def test_batches_of_one_step_draw_their_own_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = drawn(tmp_path, monkeypatch, accumulate_grad_batches=2)
    assert [len(found[step]) for step in (0, 1)] == [2, 2]
    numbers = found[0] + found[1]
    assert len(set(numbers)) == len(numbers)


def test_runs_without_accumulation_draw_as_they_always_did(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for step, (number,) in drawn(tmp_path, monkeypatch).items():
        seed = np.random.SeedSequence([7, step, 0]).generate_state(1, np.uint64)[0]
        assert number == int(
            torch.randint(2**40, (), generator=torch.Generator().manual_seed(int(seed >> np.uint64(1))))
        )
