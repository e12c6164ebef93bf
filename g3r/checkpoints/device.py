"""Where the networks compute; the rest of a reconstruction always uses the CPU."""

from __future__ import annotations

import torch

from g3r.checkpoints.trained_model import TrainedModel
from g3r.errors import InputError

DEVICES = ("auto", "cpu", "cuda")


def on_device(name: str, *models: TrainedModel | None) -> str:
    """Move the networks of some models; returns where they are, "cuda" or "cpu".

    Args:
        name: "cpu", "cuda", or "auto", which takes a GPU where torch finds one.
        models: trained models; None is passed over.

    Raises:
        InputError: "cuda" where torch finds no GPU, or another name.
    """
    if name not in DEVICES:
        raise InputError(f"device {name!r}; expected {', '.join(DEVICES)}")
    has_gpu = torch.cuda.is_available()
    if name == "cuda" and not has_gpu:
        found = "finds no GPU" if torch.backends.cuda.is_built() else "was installed without CUDA"
        raise InputError(f"--device cuda: torch {torch.__version__} {found}; pass --device cpu")
    device = "cuda" if has_gpu and name != "cpu" else "cpu"
    for model in models:
        if model is not None:
            model.network.to(device)
    return device


def is_bfloat16_fast(device_type: str) -> bool:
    """Whether a device computes in bfloat16; where a CPU only imitates it, a step takes ten times as long."""
    if device_type != "cpu":
        return True
    can = torch.cpu.get_capabilities()
    return bool(can.get("avx512_bf16") or can.get("amx_bf16"))
