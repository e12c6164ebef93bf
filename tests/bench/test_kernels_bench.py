"""`g3r-bench kernels`: its record, its table, and what it keeps when interrupted."""

import argparse
import json
from pathlib import Path

import numpy as np
import pytest

from g3r.bench import kernels
from g3r.bench.kernel_timing import copy_bytes_per_second, fused_per_second
from g3r.bench.scenes import evaluations, head_scene
from g3r.gaussians import find_overlaps
from g3r.gaussians.arrays import CloudArrays
from g3r.gaussians.render import CUTOFF_SIGMA


def options(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    kernels.add_arguments(parser)
    return parser.parse_args(arguments)


def test_the_record_and_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = tmp_path / "speed.md"
    document.write_text("before\n<!-- kernels:begin -->\nstale\n<!-- kernels:end -->\nafter\n")
    arguments = ["--sizes", "60", "--repeats", "1", "--output", str(tmp_path / "out"), "--docs", str(document)]
    assert kernels.run(options(*arguments)) == 0
    record = json.loads((tmp_path / "out" / "kernels.json").read_text())
    assert {"processor", "cores", "commit", "numba"} <= set(record["machine"])
    backends = [row["backend"] for row in record["rows"]]
    assert backends == ["numba", "reference"]
    for row in record["rows"]:
        assert row["forward_pixels_per_second"] > 0
        assert row["backward_fused_per_pixel"] > 1
    assert record["rows"][0]["step_over_kernels"] > 0
    text = document.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "stale" not in text
    assert "| numba | 60 |" in text
    assert "| numba | 60 |" in capsys.readouterr().out


def test_what_was_measured_before_ctrl_c_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("g3r.bench.kernel_timing.reference_rates", interrupted)  # measured last
    with pytest.raises(KeyboardInterrupt):
        kernels.run(options("--sizes", "60", "--repeats", "1", "--output", str(tmp_path)))
    record = json.loads((tmp_path / "kernels.json").read_text())
    assert [row["n_gaussians"] for row in record["rows"]] == [60]
    assert "| numba | 60 |" in kernels.table(record)


def test_pixels_are_counted_as_the_dense_formula_counts_them() -> None:
    scene = head_scene(20, n_slices=2)
    planes, arrays = scene.slices.planes, CloudArrays.of(scene.cloud)
    found, _ = evaluations(scene.cloud, planes, CUTOFF_SIGMA)
    covariance = np.zeros((20, 3, 3))
    for n, (a, b) in enumerate([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]):
        covariance[:, a, b] = covariance[:, b, a] = arrays.shapes[:, 3 + n]
    uv, expected = planes.pixel_uv_mm(), 0
    for k in range(len(planes)):
        rotation = planes.rotation[k]
        observed = rotation.T @ covariance @ rotation + np.diag(planes.psf_var_mm2[k])
        mean = (arrays.shapes[:, :3] - planes.center_mm[k]) @ rotation
        pixels = uv[planes.offset[k] : planes.offset[k + 1]]
        away = np.pad(pixels, ((0, 0), (0, 1)))[None] - mean[:, None]
        square = np.einsum("npi,nij,npj->np", away, np.linalg.inv(observed), away)
        expected += int((square <= CUTOFF_SIGMA**2).sum())
    assert found == pytest.approx(expected, rel=1e-3)


def test_the_limits_are_of_this_century() -> None:
    assert 1e8 < copy_bytes_per_second(1) < 1e13
    assert 1e8 < fused_per_second(1) < 1e13


def test_a_scene_fills_the_head() -> None:
    scene = head_scene(500)
    assert len(scene.cloud) == 500
    assert len(np.unique(scene.slices.stack_id)) == 3
    overlaps = find_overlaps(scene.cloud, scene.slices.planes, CUTOFF_SIGMA)
    assert len(overlaps) > 10 * 500
