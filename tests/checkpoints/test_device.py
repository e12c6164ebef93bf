"""Where the networks compute: on the CPU without a GPU, refused where one was asked for in vain."""

from __future__ import annotations

import pytest
import torch

from g3r.checkpoints.device import on_device
from g3r.checkpoints.trained_model import TrainedModel
from g3r.errors import InputError
from tests.checkpoints.altered_files import small_prior


class Moved(torch.nn.Module):
    """A network that notes where it is sent."""

    sent_to = ""

    def to(self, device: str) -> Moved:  # type: ignore[override]
        self.sent_to = device
        return self


def test_without_a_gpu_networks_stay_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    model = small_prior()
    assert on_device("auto", model, None) == "cpu"
    assert {value.device.type for value in model.network.state_dict().values()} == {"cpu"}
    with pytest.raises(InputError, match=r"--device cuda: torch .*; pass --device cpu"):
        on_device("cuda", model)


@pytest.mark.parametrize(("asked", "expected"), [("auto", "cuda"), ("cuda", "cuda"), ("cpu", "cpu")])
def test_a_gpu_is_taken_unless_the_cpu_is_asked_for(monkeypatch: pytest.MonkeyPatch, asked: str, expected: str) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    network = Moved()
    assert on_device(asked, TrainedModel(network=network, training_data="")) == expected
    assert network.sent_to == expected


def test_an_unknown_device_is_refused() -> None:
    with pytest.raises(InputError, match="'tpu'; expected auto, cpu, cuda"):
        on_device("tpu")
