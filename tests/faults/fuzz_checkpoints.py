"""Random damage to the files of prior and pose network. Each case must load completely or raise one `InputError`.

The damage has five levels: bytes of the file; bytes of its header before correct tensors; claims of the header;
description and tensors, with matching checksums; programs that would run if they were unpickled.
"""

from __future__ import annotations

import copy
import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from g3r.checkpoints.trained_model import TrainedModel, weights_digest
from g3r.checkpoints.weights_file import DESCRIPTION_KEY
from g3r.errors import InputError
from g3r.pose_network.model import PoseModel
from g3r.prior.model import Prior
from tests.checkpoints.altered_files import (
    Content,
    change_header,
    content_of,
    small_pose,
    small_prior,
    with_header,
    write_content,
)
from tests.faults.fuzz_headers import damaged_bytes

KINDS: tuple[type[TrainedModel], ...] = (Prior, PoseModel)
N_LEVELS = 10


class Canary:
    """An object that makes a folder when it is unpickled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[Any, ...]:
        import os

        return os.mkdir, (str(self.folder),)


class CheckpointFuzz:
    """Cases by number; the same seed and number give the same file.

    Args:
        folder: for the files.
        seed: of the damage.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.seed = folder, seed
        self.canary = folder / "canary"
        self.good = []
        for model in (small_prior(), small_pose()):
            model.save(folder / model.kind)
            self.good.append(((folder / model.kind).read_bytes(), content_of(folder / model.kind)))

    def run(self, number: int) -> None:
        """One case.

        Raises:
            InputError: the file was refused.
            AssertionError: a program in the file was run, or the loaded network is incomplete.
        """
        rng = np.random.default_rng([self.seed, number])
        which = int(rng.integers(len(KINDS)))
        whole, content = self.good[which]
        path = self.folder / f"case-{number}.safetensors"
        level = int(rng.integers(N_LEVELS))
        if level < 2:
            path.write_bytes(damaged_bytes(rng, bytearray(whole), len(whole)))
        elif level < 4:
            path.write_bytes(damaged_header(rng, whole))
        elif level < 6:
            path.write_bytes(change_header(whole, lambda header: change_claims(rng, header)))
        elif level < 9:
            changed = copy.deepcopy(content)
            for _ in range(int(rng.integers(1, 3))):
                change_content(rng, changed)
            if rng.random() < 0.7 and "weights_sha256" in changed:
                changed["weights_sha256"] = weights_digest(changed["weights"])
            write_content(path, changed)
        else:
            self.program(rng, content, whole, path)
        try:
            model = KINDS[which].load(path)
            assert level < 9, "a program was taken for a network"
            assert all(bool(value.isfinite().all()) for value in model.network.state_dict().values())
        except InputError as error:
            if path.name not in str(error):
                raise AssertionError(f"does not name its file: {error}") from error
            raise
        finally:
            assert not self.canary.exists(), "the file ran a program"
            path.unlink()

    def program(self, rng: np.random.Generator, content: Content, whole: bytes, path: Path) -> None:
        """A file that makes a folder if anything in it is run."""
        payload = Canary(self.canary)
        pickled = pickle.dumps(payload, protocol=int(rng.integers(6)))
        kind = rng.integers(4)
        if kind == 0:  # a bare pickle
            path.write_bytes(pickled)
        elif kind == 1:  # either format of torch.save
            torch.save({**content, "x": payload}, path, _use_new_zipfile_serialization=bool(rng.integers(2)))
        elif kind == 2:  # instead of the header
            path.write_bytes(with_header(pickled, whole))
        else:  # after a length, like the header
            path.write_bytes(with_header(b"{" + pickled, whole))


def damaged_header(rng: np.random.Generator, whole: bytes) -> bytes:
    """A file with changed bytes in its header, with a right or wrong stated length."""
    n_header = int.from_bytes(whole[:8], "little")
    header = bytearray(whole[8 : 8 + n_header])
    if rng.random() < 0.4:
        header = bytearray(damaged_bytes(rng, header, len(header)))
    else:
        for _ in range(int(rng.integers(1, 9))):
            signs = b'{}[]",:0123456789eE.-\\utfn '
            header[rng.integers(len(header))] = signs[rng.integers(len(signs))]
    said = len(header) if rng.random() < 0.8 else int(rng.choice([0, 1, n_header - 1, 2**20, 2**40, 2**63]))
    return said.to_bytes(8, "little") + bytes(header) + whole[8 + n_header :]


def change_claims(rng: np.random.Generator, header: dict[str, Any]) -> None:
    """Change a claim of the header about a tensor or the description."""
    name = list(header)[rng.integers(len(header))]
    kind = rng.integers(6)
    if kind == 0:
        header[f"new {rng.integers(9)}"] = odd_value(rng)
    elif kind == 1:
        del header[name]
    elif kind == 2 or name == "__metadata__":
        header[name] = odd_value(rng) if rng.random() < 0.5 else {DESCRIPTION_KEY: json.dumps(odd_value(rng))}
    elif kind == 3:
        header[name]["dtype"] = rng.choice(["F16", "F32", "F64", "BF16", "I64", "U8", "BOOL", "F8_E4M3", "?"])
    elif kind == 4:
        header[name]["shape"] = odd_value(rng)
    else:
        header[name]["data_offsets"] = [int(n) for n in rng.choice([-8, 0, 4, 8, 400, 2**40], 2)]


def odd_value(rng: np.random.Generator) -> Any:
    """An unexpected JSON value for an entry."""
    values: list[Callable[[], Any]] = [
        lambda: None,
        lambda: True,
        lambda: -1,
        lambda: 0,
        lambda: 2**70,
        lambda: 10**400,
        lambda: 1e300,
        lambda: float("nan"),
        lambda: float("-inf"),
        lambda: 4096,
        lambda: 0.5,
        lambda: "",
        lambda: "x" * 100_000,
        lambda: "a\nb\x1b[31m",
        lambda: [],
        lambda: {},
        lambda: [1] * 1000,
        lambda: {"a": {"b": {}}},
        lambda: [[[[]]]],
        lambda: [1, 2],
        lambda: [2**31, 2**31],
        lambda: [10**9, 10**9],
        lambda: [4096] * 8,
        lambda: [10**400],
        lambda: [-1, -1],
        lambda: [0],
        lambda: ["x"],
    ]
    return values[rng.integers(len(values))]()


def odd_tensor(rng: np.random.Generator) -> torch.Tensor:
    """A tensor that does not belong to the network."""
    values: list[Callable[[], torch.Tensor]] = [
        lambda: torch.zeros(3),
        lambda: torch.tensor(float("nan")),
        lambda: torch.zeros(0),
        lambda: torch.zeros(2, 0, 3),
        lambda: torch.ones(2, dtype=torch.bool),
        lambda: torch.full((2,), 10**9),
        lambda: torch.ones(1, dtype=torch.float64),
        lambda: torch.ones(2, dtype=torch.bfloat16),
        lambda: torch.zeros(300, 300),
    ]
    return values[rng.integers(len(values))]()


def change_content(rng: np.random.Generator, content: Content) -> None:
    """Replace, remove, rename or add an entry of the description or a tensor."""
    if rng.random() < 0.6:
        change_weights(rng, content["weights"])
        return
    inner = [content] + [value for name, value in content.items() if isinstance(value, dict) and name != "weights"]
    chosen = inner[rng.integers(len(inner))]
    names = sorted(name for name in chosen if name != "weights")
    kind = rng.integers(5)
    if kind == 0 or not names:
        chosen[f"new {rng.integers(9)}"] = odd_value(rng)
        return
    name = names[rng.integers(len(names))]
    if kind == 1:
        del chosen[name]
    elif kind == 2:
        chosen[f"{name} "] = chosen.pop(name)
    elif kind == 3 and isinstance(chosen[name], int | float):
        chosen[name] = type(chosen[name])(chosen[name] * int(rng.choice([-1, 0, 2, 1000])))
    else:
        chosen[name] = odd_value(rng)


def change_weights(rng: np.random.Generator, weights: dict[str, torch.Tensor]) -> None:
    """Replace, remove or add a tensor, or more often alter one."""
    names = sorted(weights)
    kind = rng.integers(9)
    if kind == 0 or not names:
        weights[f"new {rng.integers(9)}"] = odd_tensor(rng)
        return
    name = names[rng.integers(len(names))]
    value = weights[name]
    if kind == 1:
        del weights[name]
    elif kind == 2:
        weights[name] = odd_tensor(rng)
    elif kind == 3:
        weights[name] = value.to(torch.float16 if value.dtype == torch.float32 else torch.float32)
    elif value.numel():
        weights[name] = value.clone()
        altered = weights[name].view(-1) if value.is_floating_point() else weights[name].float().view(-1)
        altered[int(rng.integers(value.numel()))] = float(rng.choice([np.nan, np.inf, 1e38, 0.0, -1.0]))
