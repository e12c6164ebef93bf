"""Random damage to the files of both networks. Each case must load whole, or end in one `InputError`.

Damage on four levels: bytes of the file; bytes of its pickle in an archive that is right again; the entries,
with checksums that are right again; programs that would run something where they were unpickled.
"""

from __future__ import annotations

import copy
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.checkpoints.file import weights_digest
from g3r.errors import InputError
from g3r.pose_network.checkpoint import PoseCheckpoint, centred_grid, load_pose_network, save_pose_checkpoint
from g3r.pose_network.network import PoseNetwork
from g3r.prior.checkpoint import PriorCheckpoint, load_prior, save_prior_checkpoint
from g3r.prior.dgpn import DensityGatedPriorNetwork
from tests.faults.fuzz_headers import damaged_bytes

Loader = Callable[[Path], tuple[torch.nn.Module, Any]]


def small_prior(path: Path) -> Path:
    """A prior of a few hundred weights."""
    torch.manual_seed(0)
    network = DensityGatedPriorNetwork((4, 4), (1, 1), 2)
    save_prior_checkpoint(path, network, PriorCheckpoint(network.arguments(), 0.8, "nobody", {"val/psnr": 30.0}))
    return path


def small_pose(path: Path) -> Path:
    """A pose network that is as small as it can be."""
    torch.manual_seed(0)
    network = PoseNetwork([2, 5, 6, 4], 6.0, image_size=8, channels=(2, 2, 2), width=8, n_blocks=1, n_heads=2)
    heads = np.random.default_rng(0).uniform(size=(2, 5, 6, 4)).astype(np.float16).astype(np.float32)
    network.set_template(torch.from_numpy(heads))
    grid = centred_grid([2, 5, 6, 4], 6.0)
    template = AtlasTemplate(heads, grid.affine, np.array([24.0, 31.0]))
    save_pose_checkpoint(path, network, PoseCheckpoint(network.arguments(), template, "nobody", {}))
    return path


class Canary:
    """Makes a folder where it is unpickled."""

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
        files = (small_prior(folder / "prior.pt"), small_pose(folder / "pose.pt"))
        loaders: tuple[Loader, ...] = (load_prior, load_pose_network)
        self.kinds = [
            (path.read_bytes(), torch.load(path, weights_only=True), loader)
            for path, loader in zip(files, loaders, strict=True)
        ]

    def run(self, number: int) -> None:
        """One case.

        Raises:
            InputError: the file was refused.
            AssertionError: something in it was run, or what was taken is not whole.
        """
        rng = np.random.default_rng([self.seed, number])
        whole, content, load = self.kinds[rng.integers(2)]
        path = self.folder / f"case-{number}.pt"
        level = rng.integers(8)
        if level < 2:
            path.write_bytes(damaged_bytes(rng, bytearray(whole), len(whole)))
        elif level < 4:
            path.write_bytes(whole)
            rewritten(path, lambda pickled: damaged_pickle(rng, pickled))
        elif level < 7:
            changed = copy.deepcopy(content)
            for _ in range(int(rng.integers(1, 4))):
                change_entry(rng, changed)
            if rng.random() < 0.7:
                restore_digest(changed)
            torch.save(changed, path)
        else:
            self.program(rng, content, path)
        try:
            network, _ = load(path)
            assert level < 7, "a program was taken for a network"
            assert all(bool(value.isfinite().all()) for value in network.state_dict().values())
        except InputError as error:
            if path.name not in str(error):
                raise AssertionError(f"does not name its file: {error}") from error
            raise
        finally:
            assert not self.canary.exists(), "the file ran a program"
            path.unlink()

    def program(self, rng: np.random.Generator, content: dict[str, Any], path: Path) -> None:
        """A file that makes a folder where anything in it is run."""
        payload = Canary(self.canary)
        kind = rng.integers(5)
        if kind == 0:  # a bare pickle
            path.write_bytes(pickle.dumps(payload, protocol=int(rng.integers(6))))
        elif kind == 1:  # the older format of torch.save
            torch.save({**content, "network": payload}, path, _use_new_zipfile_serialization=False)
        elif kind == 2:  # among good entries
            torch.save({**content, "training_data": payload}, path)
        elif kind == 3:  # in place of a weight
            weights = dict(content["weights"])
            weights[sorted(weights)[rng.integers(len(weights))]] = payload
            torch.save({**content, "weights": weights}, path)
        else:  # in place of the whole pickle
            torch.save(content, path)
            rewritten(path, lambda _: pickle.dumps(payload, protocol=int(rng.integers(6))))


def rewritten(path: Path, change: Callable[[bytes], bytes], compression: int = zipfile.ZIP_STORED) -> None:
    """Write an archive again with another pickle, so that its checksums hold."""
    with zipfile.ZipFile(path) as archive:
        entries = [(one.filename, archive.read(one)) for one in archive.infolist()]
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in entries:
            archive.writestr(name, change(content) if name.endswith("data.pkl") else content)


def damaged_pickle(rng: np.random.Generator, pickled: bytes) -> bytes:
    """One to eight bytes turned into opcodes or anything else, or the general damage."""
    content = bytearray(pickled)
    if rng.random() < 0.4:
        return bytes(damaged_bytes(rng, content, len(content)))
    for _ in range(int(rng.integers(1, 9))):
        opcodes = b"(.0125FIJKLMNPQRSTUVXabcdeghijlopqrstu}]\x80\x81\x85\x86\x87\x88\x89\x8a\x8b\x93\x94\x95"
        at = rng.integers(len(content))
        content[at] = opcodes[rng.integers(len(opcodes))] if rng.random() < 0.5 else rng.integers(256)
    return bytes(content)


def odd_value(rng: np.random.Generator) -> Any:
    """Something that an entry should not be."""
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
        lambda: torch.zeros(3),
        lambda: torch.tensor(float("nan")),
        lambda: torch.zeros(2, 2).expand(2, 2),
        lambda: torch.zeros(1).expand(100_000, 100_000),
        lambda: torch.zeros(0),
        lambda: torch.ones(2, dtype=torch.bool),
        lambda: torch.full((2,), 10**9),
        lambda: torch.ones(1, dtype=torch.complex64),
        lambda: (1, 2),
        lambda: [10**9, 10**9],
        lambda: [4096] * 8,
        lambda: ["x"],
        lambda: b"bytes",
        lambda: {1: 2},
        lambda: {None},
    ]
    return values[rng.integers(len(values))]()


def change_entry(rng: np.random.Generator, content: dict[str, Any]) -> None:
    """Replace, remove, rename or add an entry somewhere."""
    inner = [content] + [value for value in content.values() if isinstance(value, dict)]
    chosen = inner[rng.integers(len(inner))] if rng.random() < 0.8 else content
    names = sorted(chosen, key=str)
    kind = rng.integers(6)
    if kind == 0 or not names:
        chosen[f"new {rng.integers(9)}"] = odd_value(rng)
        return
    name = names[rng.integers(len(names))]
    if kind == 1:
        del chosen[name]
    elif kind == 2:
        chosen[rng.choice([0, 1])] = chosen.pop(name)
    elif kind == 3 and isinstance(chosen[name], torch.Tensor) and 0 < chosen[name].numel() < 10**6:
        flat = chosen[name].clone().flatten().real.float()
        flat[int(rng.integers(flat.numel()))] = float(rng.choice([np.nan, np.inf, 1e38, 0.0, -1.0]))
        chosen[name] = flat.reshape(chosen[name].shape)
    elif kind == 4 and isinstance(chosen[name], int | float):
        chosen[name] = type(chosen[name])(chosen[name] * int(rng.choice([-1, 0, 2, 1000])))
    else:
        chosen[name] = odd_value(rng)


def restore_digest(content: dict[str, Any]) -> None:
    """Let the checksum agree with the weights, where it can be computed."""
    weights = content.get("weights")
    small = isinstance(weights, dict) and all(
        isinstance(name, str) and isinstance(value, torch.Tensor) and value.numel() < 10**6
        for name, value in weights.items()
    )
    if small and "weights_sha256" in content:
        content["weights_sha256"] = weights_digest({name: v.real.float() for name, v in weights.items()})
