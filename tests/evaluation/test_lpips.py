"""LPIPS: published values, agreement with torchmetrics, volumes, and reading of weights."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from g3r.errors import InputError
from g3r.evaluation.lpips import Lpips
from tests.evaluation.alexnet import CHANNELS, INPUTS, SIDES, random_states, save_states
from tests.rooms import REPOSITORY

WEIGHTS = Path(os.environ.get("G3R_TEST_DATA", REPOSITORY.parent / "shared" / "data")) / "lpips"

PUBLISHED = {"ex_p0.png": 0.722, "ex_p1.png": 0.138}
"""Distances from ex_ref.png as published by the authors (README of PerceptualSimilarity)."""


def images(n: int, seed: int = 1) -> Tensor:
    return torch.rand(n, 3, 80, 96, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def test_it_agrees_with_torchmetrics(monkeypatch: pytest.MonkeyPatch) -> None:
    theirs = pytest.importorskip("torchmetrics.functional.image.lpips", reason="torchmetrics is of the extra `train`")
    features, heads = random_states()
    layers: list[nn.Module] = []
    for n, (c, i, k) in enumerate(zip(CHANNELS, INPUTS, SIDES, strict=True)):
        layers += [nn.Conv2d(i, c, k, stride=4 if n == 0 else 1, padding=k // 2 if n else 2), nn.ReLU()]
        layers += [nn.MaxPool2d(3, 2)] if n in (0, 1) else []
    backbone = nn.Sequential(*layers)
    backbone.load_state_dict({name.removeprefix("features."): tensor for name, tensor in features.items()})
    monkeypatch.setattr(theirs, "_get_tv_model_features", lambda *args, **kwargs: backbone)
    other = theirs._LPIPS(pretrained=False, net="alex", pnet_rand=True, use_dropout=True)
    for n, head in enumerate(other.lins):
        head.model[1].weight.data = heads[f"lin{n}.model.1.weight"]
    other.eval()
    one, two = images(3), images(3, seed=2)
    with torch.no_grad():
        expected, found = other(one, two).flatten(), Lpips(features, heads)(one, two)
    assert found.tolist() == pytest.approx(expected.tolist(), rel=1e-4)  # float32 sums in a different order
    assert float(found.min()) > 0


def test_the_published_values() -> None:
    if not WEIGHTS.is_dir():
        pytest.skip(f"no AlexNet weights: {WEIGHTS} is not there (G3R_TEST_DATA)")
    lpips = Lpips.load(WEIGHTS)
    missing = [name for name in ("ex_ref.png", *PUBLISHED) if not (WEIGHTS / name).is_file()]
    if missing:
        pytest.skip(f"the example images of PerceptualSimilarity are not in {WEIGHTS}: {', '.join(missing)}")
    from PIL import Image

    def read(name: str) -> Tensor:
        pixels = np.asarray(Image.open(WEIGHTS / name).convert("RGB"), np.float32) / 127.5 - 1
        return torch.from_numpy(pixels).permute(2, 0, 1)[None]

    for name, value in PUBLISHED.items():
        assert float(lpips(read("ex_ref.png"), read(name))) == pytest.approx(
            value, abs=5e-4
        )  # three digits are published


def test_the_distance_of_volumes() -> None:
    lpips = Lpips(*random_states())
    rng = np.random.default_rng(0)
    volume = rng.random((40, 44, 36)).astype(np.float32)
    mask = np.zeros(volume.shape, bool)
    mask[5:-5, 5:-5, 5:-5] = True
    assert lpips.distance(volume, volume, mask) == 0
    noisy = volume + 0.3 * rng.standard_normal(volume.shape).astype(np.float32)
    assert lpips.distance(noisy, volume, mask) > lpips.distance(0.9 * volume + 0.1 * noisy, volume, mask) > 0
    changed_outside = np.where(mask, volume, 1.0).astype(np.float32)
    assert lpips.distance(changed_outside, volume, mask) == 0


def test_weights_are_read_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    features, heads = random_states()
    save_states(tmp_path)
    one, two = images(1), images(1, seed=2)
    expected = float(Lpips(features, heads)(one, two))
    assert float(Lpips.load(tmp_path)(one, two)) == expected
    assert float(Lpips.load(tmp_path / "alexnet-owt-7be5be79.pth")(one, two)) == expected
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="--lpips-weights"):
        Lpips.load()
    (tmp_path / "alexnet-owt-7be5be79.pth").write_bytes(b"no weights")
    with pytest.raises(InputError, match="cannot be read"):
        Lpips.load(tmp_path)
    with pytest.raises(InputError, match="not the weights of AlexNet"):
        Lpips({}, heads)
    heads["lin0.model.1.weight"] = torch.ones(1, 3, 1, 1)
    with pytest.raises(InputError, match="another network"):
        Lpips(features, heads)
