"""`g3r-export` when it is interrupted or runs out of memory."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from g3r.checkpoints.training_checkpoint import TRAINING_ENTRY
from g3r.cli.export import main
from g3r.prior.model import Prior

FAILURES = [
    (KeyboardInterrupt(), 130, "interrupted"),
    (MemoryError(), 4, "out of memory"),
    (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes"), 4, "out of memory"),
]


@pytest.mark.parametrize(("failure", "code", "says"), FAILURES)
@pytest.mark.parametrize("where", ["torch.load", "g3r.prior.model.Prior.from_training"])
def test_ctrl_c_and_little_memory_end_in_one_line(
    where: str,
    failure: BaseException,
    code: int,
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def failing(*arguments: object, **options: object) -> None:
        raise failure

    entry = {"kind": "prior", "training_data": "", "optimiser_steps": 1, "conventions": Prior.conventions}
    torch.save({"state_dict": {}, TRAINING_ENTRY: entry}, tmp_path / "last.ckpt")
    monkeypatch.setattr(where, failing)
    assert main([str(tmp_path / "last.ckpt"), str(tmp_path / "prior.safetensors")]) == code
    said = capsys.readouterr().err
    assert said.startswith(f"g3r-export: {says}")
    assert said.count("\n") == 1
    assert [one.name for one in tmp_path.iterdir()] == ["last.ckpt"]
