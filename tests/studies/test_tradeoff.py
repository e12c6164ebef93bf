"""Trade-off studies: steps read from a curve, marks in tables, a small phantom."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g3r.bench.record import machine
from g3r.planning.presets import PRESETS, changed
from studies.tradeoff import (
    convergence,
    in_plane,
    lattices,
    memory,
    peer_phantom,
    pose_rounds,
    presets,
    slice_model,
    time_budgets,
)
from studies.tradeoff.convergence import STEPS, WAYS, steps_to_near
from studies.tradeoff.presets_figure import draw_presets


def test_steps_are_interpolated_on_their_logarithm() -> None:
    assert steps_to_near([10, 40], [20.0, 22.0], 21.1) == pytest.approx(20.0)


def test_a_curve_that_is_there_from_the_start_or_never() -> None:
    assert steps_to_near([10, 40], [22.0, 22.0], 22.05) == 10
    assert steps_to_near([10, 40], [20.0, 21.0], 22.0) is None


def test_convergence_measures_every_way_against_the_best_of_all() -> None:
    rows = {}
    for way in WAYS:
        low = 0.0 if way == "started at the prior (as shipped)" else 3.0
        for k, n in enumerate(STEPS):
            row = {"case": "one", "way": way, "steps": n, "psnr_db": 20.0 + k - low, "n_gaussians": 7}
            rows[f"{way} {n}"] = row | {"cpu_s": float(n)}
    text = convergence.tables({"preset": "balanced", "rows": rows})["convergence"]
    assert text.count("never") == len(WAYS) - 1
    assert (
        "| one | started at the prior (as shipped) | 7 | 20.00 | 21.00 | 22.00 | 23.00 | 24.00 | 25.00 | 299 |" in text
    )


def test_budgets_mark_what_is_late_or_worse_and_nothing_else() -> None:
    given = [(10, 13.0, 30.0), (20, 24.1, 29.95), (30, 30.0, 29.8)]
    more = {"case": "one", "registration": "preview", "fit": "fast", "n_steps": 5, "n_gaussians": 1234}
    rows = {str(b): {"budget_s": b, "seconds": s, "busy_seconds": s + 0.1, "psnr_db": db, **more} for b, s, db in given}
    text = time_budgets.tables({"rows": rows})["time-budgets"]
    lines = [line for line in text.splitlines() if line.startswith("| one")]
    assert [line.count("(!)") for line in lines] == [1, 2, 1]
    assert "13.0 | 13.1 (!) |" in lines[0]
    assert "24.1 (!) | 24.2 (!) |" in lines[1]
    assert "29.80 (!)" in lines[2]
    assert "1,234" in lines[0]


def test_each_part_of_the_slice_model_is_left_out_once_and_all_of_them_together() -> None:
    parts = [set(changes) for changes in slice_model.WITHOUT.values()]
    assert set().union(*parts) == set(slice_model.VARIANTS[slice_model.NONE])
    assert sum(len(part) for part in parts) == len(slice_model.VARIANTS[slice_model.NONE])
    for changes in slice_model.VARIANTS.values():
        assert (changed(PRESETS["balanced"], changes) == PRESETS["balanced"]) == (not changes)
    scores = {name: {"psnr_db": 30.0 - n, "ssim": 0.9} for n, name in enumerate(slice_model.VARIANTS)}
    row = {"n_stacks": 3, "scores": scores, "prior": {name: scores[name] for name in ("as shipped", "none of these")}}
    text = slice_model.tables({"preset": "balanced", "weights": "w", "rows": {"one": row}})["slice-model"]
    assert "| one | 3 | 30.00 | 29.00 | 28.00 | 27.00 | 26.00 | 25.00 | 24.00 | 0.900 / 0.900 | 30.00 / 24.00 |" in text
    assert slice_model.line("one", row).startswith("one: as shipped 30.00, without common bias field 29.00")


def test_memory_is_judged_by_statements_and_limits() -> None:
    stated = dict.fromkeys(("weeks", "stacks", "threads"), 1) | {"preset": "preview", "more": "", "voxel_mm": 0.5}
    stated |= {"stage": "prior", "stated_bytes": 1.2e9, "measured_bytes": 1e9}
    limit = {"name": "a", "limit_bytes": 1e9, "stated_bytes": 9e8, "measured_bytes": 9e8, "changes": []}
    limit |= {"cpu_seconds": 9.0, "psnr_db": 28.0}
    refused = {"name": "a", "limit_bytes": 5e8, "refused": "too small; ask for more"}
    record: dict[str, Any] = {
        "most": 1.5,
        "machine": machine(),
        "rows": {"a": stated, "b": {"limited": [limit, refused]}},
    }
    text = memory.tables(record)
    assert "| 1.20 GB | prior | 1.00 GB | 1.20 |" in text["memory"]
    assert "| a | 1.00 GB | 0.90 GB | 0.90 GB | 9 | 28.00 | nothing |" in text["memory-limits"]
    assert "| a | 0.50 GB | refused |  |  |  | too small |" in text["memory-limits"]
    assert memory.keeps_its_word(record)
    for broken in ({"a": stated | {"measured_bytes": 1.3e9}}, {"b": {"limited": [limit | {"measured_bytes": 2e9}]}}):
        assert not memory.keeps_its_word(record | {"rows": record["rows"] | broken})


def test_the_small_phantom_has_the_size_of_the_other_methods(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert peer_phantom.main(["--output", str(tmp_path / "small")]) == 0
    said = capsys.readouterr().out
    assert "truth 64x64x64, stacks 58x58x18, 58x58x18, 58x58x18" in said
    truth = peer_phantom.small_head(1)
    extent_mm = (np.ptp(np.argwhere(truth.mask), axis=0) + 1) * peer_phantom.VOXEL_MM
    assert extent_mm.max() == pytest.approx(peer_phantom.LENGTH_MM, abs=2)


def preset_row(subject: str, n_stacks: int, preset: str, psnr_db: float) -> dict[str, Any]:
    scores = {"volume": psnr_db, "V_prior": psnr_db - 1, "V_coarse": psnr_db - 2}
    return {
        "subject": subject,
        "pixel_mm": 1.0,
        "thickness_mm": 2.5,
        "n_stacks": n_stacks,
        "preset": preset,
        "seconds": 10.0,
        "cpu_seconds": 10.0,
        "tre_mm": 0.1,
        "scores": {name: {"psnr_db": value, "ssim": 0.9} for name, value in scores.items()},
        "pose_rounds": 1,
    }


def test_presets_are_compared_on_the_same_subjects_alone(tmp_path: Path) -> None:
    first, second, third = (spec.name for spec in presets.SUBJECTS[:3])
    given = [
        (first, "preview", 22.0),
        (second, "preview", 21.0),
        (first, "fast", 30.0),
        (second, "fast", 31.0),
        (third, "fast", 20.0),
    ]
    given += [(first, "balanced", 31.0), (second, "balanced", 30.5), (first, "accurate", 31.5)]
    rows = {f"{name}, 3, {preset}": preset_row(name, 3, preset, db) for name, preset, db in given}
    rows["two"] = preset_row(first, 2, "balanced", 28.0)
    rows["two, longer"] = preset_row(first, 2, "accurate", 28.5)
    rows["one"] = preset_row(first, 1, "balanced", 20.0)
    found = presets.tables({"weights": "w", "rows": rows})
    assert f"| {first} | 1 | `balanced` | 10 | 20.00 | 19.00 | 18.00 | +1.00 | 0.10 | 1 |" in found["single-stack"]
    assert "| 1 | `balanced` | 10 | 20.00" not in found["fewer-stacks"]
    gains = "+9.00 (least +8.00) |  | +0.25 (least -0.50) |  | +0.50 (least +0.50)"
    assert f"| mean gain over the quicker one |  |  |  | {gains} |" in found["presets"]
    for preset, values in (("balanced", "28.00 | 27.00 | 26.00"), ("accurate", "28.50 | 27.50 | 26.50")):
        assert f"| {first} | 2 | `{preset}` | 10 | {values} | +1.00 | 0.10 | 1 |" in found["fewer-stacks"]
    draw_presets(rows, presets.TRADE, tmp_path / "trade.png")
    assert (tmp_path / "trade.png").stat().st_size > 10_000


def test_subjects_of_the_presets_differ_in_size_and_are_not_those_that_were_trained_on() -> None:
    assert len({spec.name for spec in presets.SUBJECTS}) == 8
    assert len({(spec.pixel_mm, spec.thickness_mm) for spec in presets.SUBJECTS}) == 4
    for volume in presets.HEADS:
        assert {spec.motion for spec in presets.SUBJECTS if spec.volume == volume} == set(presets.MOTIONS)
        assert len({spec.pixel_mm for spec in presets.SUBJECTS if spec.volume == volume}) == 2
    first, *_ = presets.SUBJECTS
    for stack in first.acquisition(3):
        assert (stack.resolution_mm, stack.thickness_mm, stack.gap_mm) == (0.7, 3.0, 0.0)
    assert len([task.key for task in presets.tasks(presets.STUDY.parser().parse_args([]))]) == 56
    one = [task.key for task in presets.tasks(presets.STUDY.parser().parse_args(["--cases", ", 1, balanced"]))]
    assert one == [f"{spec.name}, 1, balanced" for spec in presets.SUBJECTS]


def test_rounds_are_shown_side_by_side() -> None:
    by_round = {str(n): {"psnr_db": 30.0 + n, "ssim": 0.9} for n in pose_rounds.ROUNDS}
    row = {"case": "one", "n_stacks": 2, "volume": by_round, "prior": by_round, "kept": {"0": 0, "1": 1, "2": 1}}
    row["poses_mm"] = {"0": 0.3, "1": 0.2, "2": 0.1}
    text = pose_rounds.tables({"preset": "balanced", "weights": "w", "rows": {"one, 2": row}})["pose-rounds"]
    assert "| one | 2 | 30.00 | 31.00 | 32.00 | 30.00 | 31.00 | 32.00 | 0.30 | 0.20 | 0.10 | 1 |" in text
    assert pose_rounds.line("one, 2", row) == "one, 2: 0 rounds 30.00, 1 rounds 31.00, 2 rounds 32.00"


def test_widths_in_plane_have_a_table_of_cases_and_one_of_real_stacks() -> None:
    scores = {f"width {width:g}": 30.0 + width for width in in_plane.WIDTHS}
    predicted = {width: {f"{judged:g}": psnr - judged for judged in in_plane.JUDGED} for width, psnr in scores.items()}
    rows: dict[str, dict[str, Any]] = {"one": {"psnr_db": scores}, "real, without two": {"predicted_db": predicted}}
    text = in_plane.tables({"preset": "fast", "rows": rows})["in-plane"]
    assert "| one | 31.00 | 30.85 | 30.75 |" in text
    assert "| without two | 0.3 | 30.70 | 30.55 | 30.45 |" in text
    assert text.count("| without two |") == len(in_plane.JUDGED)
    assert in_plane.line("real", rows["real, without two"]).startswith("real: width 1: 30.70, width 0.85: 30.55")


def test_numbers_of_lattices_have_their_gain_and_their_seconds() -> None:
    scores = {f"lattices {number}": 30.0 + 0.1 * number for number in lattices.NUMBERS}
    row = {"psnr_db": scores, "cpu_s": {name: 8.0 * n for name, n in zip(scores, lattices.NUMBERS, strict=True)}}
    text = lattices.tables({"preset": "accurate", "rows": {"one": row}})["lattices"]
    assert "| one | 30.10 | 30.30 | 30.60 | 8 | 24 | 48 |" in text
    assert lattices.line("one", row) == "one: lattices 1: 30.10, lattices 3: 30.30, lattices 6: 30.60"
