"""Tables of the documentation: cells, levels, and the markers that hold their place."""

from __future__ import annotations

import pytest

from g3r.errors import InputError
from g3r.planning.presets import PRESETS, changed
from studies.motion import bias as motion_bias
from studies.motion import layers as motion_layers
from studies.motion import sweep as motion_sweep
from studies.runs import preset_settings


def subject(level, median, p90, *, warned, psnr=None):
    row = {
        "level": level,
        "seed": 1,
        "header_mm": 9.0,
        "median_mm": median,
        "p90_mm": p90,
        "worst_mm": 2 * p90,
        "bad": median >= 1,
        "warned": warned,
        "seconds": 20.0,
        "cpu_seconds": 35.0,
        "orientation_deg": 2.0 if median < 1 else None if level == "mild" else 90.0,
    }
    return row if psnr is None else {**row, "psnr_db": psnr}


def test_sweep_counts_who_was_warned():
    rows = {
        "a": subject("severe", 0.4, 1.0, warned=False),
        "b": subject("severe", 0.6, 2.0, warned=True),
        "c": subject("severe", 8.0, 20.0, warned=True),
        "d": subject("severe", 1.0, 3.0, warned=False),  # not under a millimetre
        "e": subject("mild", 0.3, 0.5, warned=False),
    }
    text = motion_sweep.sweep_tables({"preset": "balanced", "full": False, "jobs": 1, "threads": 2, "subjects": rows})
    assert "| mild | 1 | 9.0 | 100% | 95% | 0.30 | 0.50 | 0 | 0 | 0 | 100% | 20 | 35 |" in text
    assert "| severe | 4 | 9.0 | 50% | 60% | 0.80 | 2.50 | 1 | 1 | 1 | 50% | 20 | 35 |" in text
    assert "| c | 9.0 | 8.00 | 20.00 | 40.0 | yes | 90.0 | 20 | 35 |" in text
    assert "moderate" not in text


def test_sweep_with_volumes():
    rows = {"a": subject("mild", 0.4, 1.0, warned=False, psnr=28.04), "b": subject("mild", 9, 9, warned=True)}
    text = motion_sweep.sweep_tables({"preset": "fast", "full": True, "jobs": 2, "threads": 1, "subjects": rows})
    assert "| 35 | 28.0 |" in text
    assert "| 35 | 28.04 |" in text
    assert "| 35 | none |" in text  # refused: no volume


def test_layer_tables_leave_gaps_where_nothing_was_measured():
    figures = {"median_mm": 0.5, "p90_mm": 1.25, "seconds": 12.3, "psnr_db": 28.0}
    cases = {
        "one": {"layers": {"headers": figures, "slices": figures}, "without": {"everything": figures}},
        "two": {"layers": {"headers": figures}, "without": {"stacks": figures}},
    }
    text = motion_layers.layer_tables({"preset": "balanced", "threads": 2, "cases": cases})
    assert "| one | 0.50 / 1.25 | 0.50 / 1.25 |" in text
    assert "| two | 0.50 / 1.25 |  |" in text
    assert "| case | everything | without stacks |" in text
    assert "| two |  | 28.00 (0.50) |" in text


def test_bias_table():
    run = {
        "volume": "v",
        "bias": 0.15,
        "shading": "estimated",
        "seed": 7,
        "median_mm": 0.5,
        "p90_mm": 1.0,
        "warned": False,
        "psnr_db": 28.0,
        "ssim": 0.97,
        "seconds": 26.4,
    }
    text = motion_bias.table({"preset": "balanced", "threads": 2, "runs": [run]})
    assert "| v | 7 | 0.15 | estimated | 0.50 | 1.00 | 28.00 | 0.970 | - | 26 |" in text


def test_nested_settings():
    settings = PRESETS["balanced"]
    other = changed(settings, {"registration.n_rounds": 0, "use_prior": False})
    assert (other.registration.n_rounds, other.use_prior) == (0, False)
    assert other.slice_stage == settings.slice_stage
    with pytest.raises(ValueError, match="no field 'n_turns'"):
        changed(settings, {"registration.n_turns": 1})
    with pytest.raises(InputError, match="--preset best"):
        preset_settings("best")


def test_named_variants_are_options_that_exist():
    tables = [motion_layers.WITHOUT, motion_bias.VARIANTS, {x.name: x.options for x in motion_layers.LAYERS}]
    for options in [one for table in tables for one in table.values()]:
        changed(PRESETS["balanced"], options)
