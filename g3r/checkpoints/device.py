"""The device of the networks; the rest of a reconstruction always uses the CPU."""

from __future__ import annotations

import ctypes
import sys
from importlib.metadata import version

from g3r.errors import InputError
from g3r.run.on_demand import torch

DEVICES = ("auto", "cpu", "cuda")


def device_of(name: str) -> str:
    """The device for networks, "cuda" or "cpu".

    Args:
        name: "cpu", "cuda", or "auto", which takes a GPU if torch finds one.

    Raises:
        InputError: "cuda" without a GPU that torch finds, or an unknown name.
    """
    if name not in DEVICES:
        raise InputError(f"device {name!r}; expected {', '.join(DEVICES)}")
    if name == "cpu" or (name == "auto" and knows_no_gpu()):
        return "cpu"
    has_gpu = torch.cuda.is_available()
    if name == "cuda" and not has_gpu:
        found = "finds no GPU" if torch.backends.cuda.is_built() else "was installed without CUDA"
        raise InputError(f"--device cuda: torch {torch.__version__} {found}; pass --device cpu")
    return "cuda" if has_gpu else "cpu"


def knows_no_gpu() -> bool:
    """Whether there is certainly no GPU for torch; determined without importing it."""
    build = version("torch")
    if sys.platform == "darwin" or build.endswith("+cpu"):
        return True
    return "rocm" not in build and not has_cuda_driver()  # ROCm needs no driver of NVIDIA's


def has_cuda_driver() -> bool:
    """Whether NVIDIA's driver is installed. PyPI's torch is built for CUDA, but most machines have none."""
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return True


def is_bfloat16_fast(device_type: str) -> bool:
    """Whether a device has native bfloat16; on a CPU that emulates it a step takes ten times as long."""
    if device_type != "cpu":
        return True
    can = torch.cpu.get_capabilities()
    return bool(can.get("avx512_bf16") or can.get("amx_bf16"))
