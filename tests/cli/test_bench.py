"""g3r-bench: usage, refusals, and small runs from end to end."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from data_synth import cli as simulate
from g3r.bench.scaling import GROWING, measured_growth
from g3r.bench.scaling_tables import draw_scaling, scaling_tables
from g3r.bench.trade import _measure_fits
from g3r.bench.trade_figure import draw_trade
from g3r.bench.trade_tables import trade_tables
from g3r.cli import bench
from g3r.evaluation.case import SimulatedCase
from g3r.planning.presets import PRESETS

MACHINE = {
    "processor": "made up",
    "cores": 2,
    "threads": 2,
    "python": "3",
    "torch": "2",
    "numba": "0",
    "g3r": "0",
    "commit": None,
}


def test_names_its_commands(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        bench.main(["--help"])
    said = capsys.readouterr().out
    assert all(name in said for name in ("kernels", "scaling", "trade"))
    with pytest.raises(SystemExit, match="2"):
        bench.main(["nothing"])


def test_presets_are_named_once() -> None:
    from g3r.planning import PRESET_NAMES
    from g3r.planning.presets import PRESETS

    assert tuple(PRESETS) == PRESET_NAMES


@pytest.mark.parametrize(
    "words",
    [
        ["trade"],
        ["trade", "nowhere"],
        ["trade", "nowhere", "--repeats", "0"],
        ["trade", "nowhere", "--sweeps", "--base", "preview"],
        ["trade", "nowhere", "--figure", "figure.pdf"],
        ["trade", "--redraw", "--output", "nowhere"],
        ["kernels", "--redraw", "--output", "nowhere"],
        ["scaling", "--sizes", "1"],
    ],
)
def test_bad_input_is_one_line(
    words: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert bench.main(words) == 3
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    assert said.err.startswith(f"g3r-bench {words[0]}: ")
    assert not said.out


@pytest.mark.parametrize("text", ['{"machine": ', '{"machine": {}}', "[]", "\x00"])
@pytest.mark.parametrize("name", ["trade", "scaling", "kernels"])
def test_a_damaged_record_is_one_line(name: str, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / f"{name}.json").write_text(text)
    assert bench.main([name, "--redraw", "--output", str(tmp_path)]) == 3
    said = capsys.readouterr().err
    assert f"{name}.json: holds no record of g3r-bench {name} (" in said
    assert said.count("\n") == 1


def test_a_figure_that_cannot_be_written_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "trade.json").write_text(json.dumps(made_record()))
    (tmp_path / "file").write_text("")
    figure = tmp_path / "file" / "trade.png"
    assert bench.main(["trade", "--redraw", "--output", str(tmp_path), "--figure", str(figure)]) == 3
    said = capsys.readouterr().err
    assert said.startswith(f"g3r-bench trade: {figure}: cannot be written (")
    assert said.endswith("; choose another --figure, with --redraw\n")
    assert said.count("\n") == 1


def preset(seconds: float, psnr: float) -> dict[str, Any]:
    return {
        "seconds": seconds,
        "cpu_seconds": 2 * seconds,
        "peak_bytes": 1_500_000_000,
        "n_gaussians": 12345,
        "stages": {"motion": seconds - 5, "fit to slices": 5.0},
        "ssim": 0.9,
        "tre_mm": 0.5,
        "psnr_db": psnr,
        "stages_cpu": {"motion": seconds - 5, "fit to slices": 5.0},
    }


def variant(seconds: float, psnr: float, *, same: bool = False) -> dict[str, Any]:
    return {
        "seconds": seconds,
        "stages": {"fit to prior": 1.0, "fit to slices": seconds - 1},
        "psnr_db": psnr,
        "ssim": 0.9,
        "tre_mm": 0.5,
        "n_gaussians": 100,
        "same_as_base": same,
    }


def made_record() -> dict[str, Any]:
    fit = {"curve": {"step": [1, 2], "seconds_before_end": [2.0, 0.0], "psnr_db": [20.0, 24.0]}}
    presets = {"preview": preset(16.0, 20.0), "balanced": preset(60.0, 24.0), "accurate": preset(200.0, 24.6)}
    case = {
        "presets": presets,
        "sweeps": {"cut-off": {"2 sigma": variant(10.0, 23.0), "3.2 sigma": variant(20.0, 24.0, same=True)}},
        "fits": {"balanced": fit},
    }
    return {"machine": MACHINE, "repeats": 3, "base": "balanced", "cases": {"made": case}}


def test_trade_tables_and_figure(tmp_path: Path) -> None:
    text = trade_tables(made_record())
    assert "| made | `preview` | 16.0 (!) | 15 | 4.60 (!) | 4 |" in text
    assert "| made | `balanced` | 60.0 | 75 | 0.60 (!) | 0.5 |" in text
    assert "| made | `accurate` | 200.0 | 240 |  |  |" in text
    assert "| cut-off | 2 sigma | 50.0 | 10.0 | 100 | 23.00 |" in text  # 60 - 20 + 10 seconds
    assert "| cut-off | 3.2 sigma (`balanced`) | 60.0 |" in text
    assert "medians of 3 runs" in text
    draw_trade(made_record(), tmp_path / "made" / "trade.png")
    assert (tmp_path / "made" / "trade.png").stat().st_size > 10_000


def test_presets_without_a_fit_are_passed_over_and_every_fit_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    fitted: list[str] = []
    kept: list[str] = []
    case = cast("SimulatedCase", SimpleNamespace(name="made"))
    options = argparse.Namespace(presets=["preview", "fast"], base="fast")
    record: dict[str, Any] = {"cases": {"made": {}}}

    def measured(case: object, settings: object, motion: object = None) -> dict[str, Any]:
        assert settings != PRESETS["preview"]
        fitted.append("one")
        return {}

    monkeypatch.setattr("g3r.bench.fits.measured_fit", measured)
    monkeypatch.setattr("g3r.bench.fits.shared_registration", lambda case, settings: None)
    _measure_fits(case, options, record, lambda so_far: kept.append(json.dumps(so_far)))
    found = record["cases"]["made"]
    assert list(found["fits"]) == ["fast"]
    n_labels = sum(map(len, found["sweeps"].values()))
    assert len(fitted) > 10
    assert len(set(kept)) == 1 + n_labels  # the record grows every time


def test_scaling_measures_what_grows(tmp_path: Path) -> None:
    rows = measured_growth("output voxels", 2)
    assert [row["size"] for row in rows] == [30**3, 38**3]
    assert rows[1]["evaluations"] > 1.5 * rows[0]["evaluations"]
    assert all(row[key]["volume"] > 0 for row in rows for key in ("seconds", "setup_seconds"))
    record = {"machine": MACHINE, "growing": {"output voxels": rows}}
    assert "volume, output voxels" in scaling_tables(record)
    draw_scaling(record, tmp_path / "scaling.png")
    assert (tmp_path / "scaling.png").stat().st_size > 10_000


def test_work_is_proportional_to_what_grows() -> None:
    from dataclasses import replace

    from g3r.bench.scenes import SceneSize, evaluations, made_cloud, made_slices

    base = SceneSize(n_gaussians=400, n_slices=12, n_pixels=256)
    for field in ("n_gaussians", "n_slices", "n_pixels"):
        work = []
        for factor in (1, 4):
            size = replace(base, **{field: factor * getattr(base, field)})
            cloud = made_cloud(size)
            planes = made_slices(size, cloud).planes
            work.append(evaluations(cloud, planes, 3.2)[0])
        assert work[1] / work[0] == pytest.approx(4, rel=0.1), field
    assert {field for field, *_ in GROWING.values()} == {"n_gaussians", "n_slices", "n_pixels", "n_voxels"}


@pytest.mark.slow
def test_trade_from_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--phantom", "20", "--resolution", "1.5", "--thickness", "4", "--seed", "61009"]
    assert simulate.main([*words, "--output", str(tmp_path / "case")]) == 0
    page = tmp_path / "page.md"
    page.write_text("<!-- trade:begin -->\n<!-- trade:end -->\n", encoding="utf-8")
    words = ["trade", str(tmp_path / "case"), "--repeats", "1", "--presets", "preview", "fast", "--base", "fast"]
    words += ["--sweeps", "--output", str(tmp_path), "--docs", str(page), "--figure", str(tmp_path / "t.png")]
    assert bench.main(words) == 0
    case = json.loads((tmp_path / "trade.json").read_text())["cases"]["case"]
    row = case["presets"]["preview"]
    assert row["seconds"] == pytest.approx(sum(row["stages"].values()), abs=0.1)
    assert row["peak_bytes"] > 1e8
    assert set(case["fits"]) == {"fast"}  # a preview has no fit
    psnr_db = case["presets"]["fast"]["psnr_db"]
    assert case["fits"]["fast"]["psnr_db"] == pytest.approx(psnr_db, abs=0.5)
    assert case["fits"]["fast"]["curve"]["psnr_db"][-1] == pytest.approx(psnr_db, abs=0.5)
    assert set(case["sweeps"]) == {"Gaussians", "iterations", "cut-off", "resolution"}
    assert "`preview`" in page.read_text(encoding="utf-8")
    assert (tmp_path / "t.png").is_file()
