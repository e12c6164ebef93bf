"""Motion studies: subjects, counts, tables, and jerks in the order of time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g3r.acquisition.interleave import place_in_time
from g3r.evaluation.pose_error import PoseTable
from g3r.geometry import RigidPose
from g3r.planning.presets import PRESETS, changed
from studies.motion import bias, crossing, layers, sweep
from studies.motion.figure import INTERLEAVE, draw_slice_errors, jerk_slices

SETTINGS = {"preset": "balanced", "jobs": 1, "threads": 2}


def test_every_subject_has_a_seed_of_its_own() -> None:
    kinds = [{"turned": turned, "development": dev} for turned in (False, True) for dev in (False, True)]
    every = [one for kind in kinds for one in sweep.specs(sweep.LEVELS, 100, **kind)]
    assert len({one.seed for one in every}) == len({one.name for one in every}) == 1200
    assert sweep.specs(["severe"], 2)[1] == sweep.specs(sweep.LEVELS, 10)[21]


def subject(
    level: str,
    median: float,
    p90: float,
    *,
    warned: bool,
    off: float | None = 0.01,
    psnr: float | None = None,
    turned: bool = False,
) -> dict[str, Any]:
    row = {"level": level, "seed": 1, "header_mm": 9.0, "median_mm": median, "p90_mm": p90, "worst_mm": 2 * p90}
    row |= {"bad": median >= 1, "warned": warned, "seconds": 20.0, "cpu_seconds": 35.0, "turned": turned}
    row["off_share"] = off
    row["orientation_deg"] = 2.0 if median < 1 else None if level == "mild" else 90.0
    return row if psnr is None else {**row, "psnr_db": psnr}


def test_sweep_counts_who_was_warned() -> None:
    rows = {
        "a": subject("severe", 0.4, 1.0, warned=False),
        "b": subject("severe", 0.6, 2.0, warned=True, off=0.2),
        "c": subject("severe", 8.0, 20.0, warned=True, off=None),  # refused
        "d": subject("severe", 1.0, 3.0, warned=False, off=0.06),  # median not under 1 mm
        "e": subject("mild", 0.3, 0.5, warned=False),
        "f": subject("mild", 5.0, 7.0, warned=True, off=None, turned=True),
    }
    found = sweep.tables(SETTINGS | {"full": False, "rows": rows})
    text = found["sweep"]
    assert "| mild | 1 | 9.0 | 100% | 95% | 0.30 | 0.50 | 1.0% | 0 | 0 | 0 | 0 | 100% | 20 | 35 |" in text
    assert "| severe | 4 | 9.0 | 50% | 60% | 0.80 | 2.50 | 9.0% | 1 | 1 | 1 | 1 | 50% | 20 | 35 |" in text
    assert "| c | 9.0 | 8.00 | 20.00 | 40.0 | none | yes | 90.0 | 20 | 35 |" in text
    assert "moderate" not in text
    assert "| mild | 1 | 9.0 | 0% | 95% | 5.00 | 7.00 | none | 0 |" in found["sweep-turned"]


def test_sweep_with_volumes() -> None:
    rows = {"a": subject("mild", 0.4, 1.0, warned=False, psnr=28.04), "b": subject("mild", 9, 9, warned=True)}
    text = sweep.tables(SETTINGS | {"full": True, "rows": rows})["sweep"]
    assert "| 35 | 28.0 |" in text
    assert "| 35 | 28.04 |" in text
    assert "| 35 | none |" in text  # refused: no volume


def test_layer_tables_leave_gaps_where_nothing_was_measured() -> None:
    figures = {"median_mm": 0.5, "p90_mm": 1.25, "seconds": 12.3, "psnr_db": 28.0}
    cases = {
        "one": {"layers": {"headers": figures, "best start": figures}, "without": {"everything": figures}},
        "two": {"layers": {"headers": figures}, "without": {"stacks": figures}},
    }
    text = layers.tables(SETTINGS | {"rows": cases})["layers"]
    assert "| one | 0.50 / 1.25 | 0.50 / 1.25 |" in text
    assert "| two | 0.50 / 1.25 |  |" in text
    assert "| one | 12 |" in text
    assert "| case | everything | without stacks |" in text
    assert "| two |  | 28.00 (0.50) |" in text


def test_bias_table() -> None:
    row = {"volume": "v", "bias": 0.15, "bias_field": "estimated", "seed": 7, "median_mm": 0.5, "p90_mm": 1.0}
    row |= {"warned": False, "psnr_db": 28.0, "ssim": 0.97, "seconds": 26.4}
    alone = {name: value for name, value in row.items() if name not in ("psnr_db", "ssim")}
    text = bias.tables(SETTINGS | {"rows": {"a": row, "b": alone}})["bias"]
    assert "| v | 7 | 0.15 | estimated | 0.50 | 1.00 | 28.00 | 0.970 | - | 26 |" in text
    assert "| v | 7 | 0.15 | estimated | 0.50 | 1.00 |  |  | - | 26 |" in text


@pytest.mark.parametrize("variants", [layers.WITHOUT, bias.VARIANTS, {x.name: x.options for x in layers.LAYERS}])
def test_variants_are_settings_that_exist(variants: dict[str, dict[str, Any]]) -> None:
    for options in variants.values():
        changed(PRESETS["balanced"], options)


def test_jerks_are_found_in_the_order_of_time() -> None:
    """Ten slices in the order 0 2 4 6 8 1 3 5 7 9; the head jumps by 5 mm before slice 8."""
    place = place_in_time(10, INTERLEAVE)
    assert place.tolist() == [0, 5, 1, 6, 2, 7, 3, 8, 4, 9]
    shift = np.zeros((10, 3))
    shift[:, 0] = 0.1 * place + 5.0 * (place >= 4)
    keys = tuple((0, k) for k in range(10))
    points = {key: np.array([[10.0, 0, key[1]], [0, 10.0, key[1]]]) for key in keys}
    poses = RigidPose(np.tile(np.eye(3), (10, 1, 1)), shift)
    assert jerk_slices(PoseTable(keys, poses), points) == [[0, 4]]


def test_figure_of_layers_known_and_new(tmp_path: Path) -> None:
    per_slice = [[0, k, 0.1 * k] for k in range(10)]
    shown = {name: {"per_slice_mm": per_slice} for name in ("headers", "slices", "something new")}
    case = {"layers": shown, "n_slices": [10], "jerks": [[0, 4]]}
    draw_slice_errors({"a": case, "b": case, "c": case}, tmp_path / "made" / "figure.png")
    assert [path.name for path in (tmp_path / "made").iterdir()] == ["figure.png"]


def test_pairs_are_counted_by_their_crossing_angle_and_by_what_warns() -> None:
    assert len({spec.seed for spec in crossing.specs()}) == len(crossing.specs()) == 45
    assert all(len({one.oblique_deg for one in spec.acquisition(3)}) == 1 for spec in crossing.specs())
    common = {"level": "mild", "tilt_deg": 12.0, "p90_mm": 2.0}
    angle = [f"{crossing.PARALLEL} (11 degrees ...)"]
    rows = {
        "a": {"crossing_deg": 11.0, "median_mm": 3.0, "off_share": 0.6, "warned": True, "warnings": angle},
        "b": {"crossing_deg": 14.9, "median_mm": 1.0, "off_share": 0.0, "warned": True, "warnings": angle},
        "c": {"crossing_deg": 90.0, "median_mm": 0.2, "off_share": 0.06, "warned": True, "warnings": ["x: failed"]},
    }
    text = crossing.tables({"preset": "fast", "rows": {name: common | row for name, row in rows.items()}})["crossing"]
    assert "| 0 to 15 | 2 | 2.00 | 3.00 | 1 | 1 | 0 |" in text
    assert "| 45 to 90 | 1 | 0.20 | 0.20 | 1 | 1 | 1 |" in text
    assert "| 15 to 30 |" not in text
