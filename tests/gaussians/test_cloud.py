"""Saving and loading of a cloud, and refusals."""

from pathlib import Path

import numpy as np
import pytest
import torch

from g3r.errors import InputError
from g3r.gaussians import GaussianCloud
from tests.gaussians.scenes import make_cloud, single


def test_save_and_load(tmp_path: Path) -> None:
    cloud = single(make_cloud(21, 12, origin=(1e4 + 1e-7, 0, -3)))
    cloud.save(tmp_path / "cloud.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.npz"]
    back = GaussianCloud.load(tmp_path / "cloud.npz")
    assert all(torch.equal(a, b) for a, b in zip(cloud.parameters, back.parameters, strict=True))
    np.testing.assert_array_equal(back.origin_mm, cloud.origin_mm)
    assert all(p.dtype == torch.float32 for p in back.parameters)


@pytest.mark.parametrize("kind", ["missing", "text", "cut off", "array", "other npz"])
def test_what_is_no_cloud_is_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "cloud.npz"
    if kind == "text":
        path.write_text("hello")
    elif kind == "cut off":
        single(make_cloud(22, 50)).save(path)
        path.write_bytes(path.read_bytes()[:700])
    elif kind == "array":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    elif kind == "other npz":
        np.savez(path, mean_mm=np.zeros((2, 3)))
    with pytest.raises(InputError, match=r"cloud\.npz: not a cloud"):
        GaussianCloud.load(path)


def test_shapes_that_do_not_belong_together_are_refused() -> None:
    cloud = make_cloud(23, 3)
    with pytest.raises(ValueError, match="amplitude has shape"):
        cloud.with_amplitude(torch.zeros(2))
