"""Device of the networks: the CPU without a GPU, and a refusal if a missing GPU was requested."""

from __future__ import annotations

import pytest
import torch

from g3r.checkpoints import device
from g3r.checkpoints.device import device_of
from g3r.errors import InputError


@pytest.fixture(params=[True, False], ids=["CPU build", "CUDA build"])
def build(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """The torch build: for CPUs only, or for GPUs."""
    monkeypatch.setattr(device, "knows_no_gpu", lambda: request.param)
    return bool(request.param)


def test_without_a_gpu_networks_stay_on_the_cpu(build: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert device_of("auto") == device_of("cpu") == "cpu"
    with pytest.raises(InputError, match=r"--device cuda: torch .*; pass --device cpu"):
        device_of("cuda")


@pytest.mark.parametrize(("asked", "expected"), [("auto", "cuda"), ("cuda", "cuda"), ("cpu", "cpu")])
def test_a_gpu_is_taken_unless_the_cpu_is_asked_for(monkeypatch: pytest.MonkeyPatch, asked: str, expected: str) -> None:
    monkeypatch.setattr(device, "knows_no_gpu", lambda: False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert device_of(asked) == expected


def test_a_build_for_cpus_is_known_without_torch() -> None:
    assert device.knows_no_gpu() or not torch.__version__.endswith("+cpu")


@pytest.mark.parametrize(
    ("build", "driver", "known"),
    [
        ("2.13.0+cpu", True, True),
        ("2.13.0", False, True),  # PyPI's, on a machine without a GPU
        ("2.13.0", True, False),
        ("2.13.0+cu128", True, False),
        ("2.13.0+rocm6.4", False, False),
    ],
)
def test_a_machine_without_a_driver_is_known_without_torch(
    monkeypatch: pytest.MonkeyPatch, build: str, driver: bool, known: bool
) -> None:
    monkeypatch.setattr(device.sys, "platform", "linux")
    monkeypatch.setattr(device, "version", lambda name: build)
    monkeypatch.setattr(device, "has_cuda_driver", lambda: driver)
    assert device.knows_no_gpu() is known


def test_a_driver_is_found_where_its_library_loads(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(name: str) -> None:
        if name not in present:
            raise OSError(name)

    monkeypatch.setattr(device.ctypes, "CDLL", load)
    present: set[str] = set()
    assert not device.has_cuda_driver()
    present = {"libcuda.so.1", "nvcuda.dll"}
    assert device.has_cuda_driver()


def test_an_unknown_device_is_refused() -> None:
    with pytest.raises(InputError, match="'tpu'; expected auto, cpu, cuda"):
        device_of("tpu")
