"""The record of `g3r-bench trade` as points in the plane of seconds and quality, and as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from g3r.bench.record import machine_line, markdown_table

ALLOWED_SECONDS = {"preview": 15.0, "fast": 30.0, "balanced": 75.0, "accurate": 240.0}
"""Time limit of the whole command by preset, on two cores, for three stacks of a 30-week head."""

ALLOWED_LOSS_DB = {"preview": 4.0, "fast": 1.5, "balanced": 0.5}
"""Largest loss of PSNR against `accurate` on the same case."""

BEST = "accurate"

GB = 1e9


@dataclass(frozen=True)
class Point:
    """Seconds and quality of one setting on one case."""

    label: str
    seconds: float
    psnr_db: float


def points_of(case: Mapping[str, Any], base: str) -> list[Point]:
    """Points of the presets, and of the sweeps on the presets' time scale.

    A sweep is measured without start-up and registration. Its seconds are those of the command of the varied preset,
    with the stages that differ exchanged.
    """
    presets = case["presets"]
    points = [Point(name, row["seconds"], row["psnr_db"]) for name, row in presets.items()]
    for variants in case.get("sweeps", {}).values():
        offset = sweep_offset(case, base)
        points += [
            Point(label, row["seconds"] + offset, row["psnr_db"])
            for label, row in variants.items()
            if not row["same_as_base"]
        ]
    return points


def sweep_offset(case: Mapping[str, Any], base: str) -> float:
    """Seconds of the base preset's command outside its fit on a given registration.

    Zero if the preset was not measured as a command.
    """
    alike = [row for variants in case["sweeps"].values() for row in variants.values() if row["same_as_base"]]
    if base not in case["presets"] or not alike:
        return 0.0
    return float(case["presets"][base]["seconds"] - alike[0]["seconds"])


def pareto_front(seconds: Sequence[float], quality: Sequence[float]) -> list[int]:
    """Indices of the points that no other point beats in both time and quality, fastest first.

    Among points with equal values the first is kept.

    Args:
        seconds: less is better.
        quality: more is better.

    Raises:
        ValueError: the lists differ in length.
    """
    if len(seconds) != len(quality):
        raise ValueError(f"{len(seconds)} times and {len(quality)} qualities; expected as many")
    front: list[int] = []
    for n in sorted(range(len(seconds)), key=lambda k: (seconds[k], -quality[k])):
        if not front or quality[n] > quality[front[-1]]:
            front.append(n)
    return front


def trade_tables(record: Mapping[str, Any]) -> str:
    """All tables, with the machine below them."""
    parts = [_preset_table(record)]
    if any(BEST in case["presets"] for case in record["cases"].values()):
        parts.append(_check_table(record))
    parts += [_stage_table(name, case) for name, case in record["cases"].items()]
    parts += [_sweep_table(name, case, record["base"]) for name, case in record["cases"].items() if "sweeps" in case]
    runs = "one run" if record["repeats"] == 1 else f"medians of {record['repeats']} runs"
    parts.append(
        f"Seconds are those of the whole command `g3r-infer`, {runs}, kernels compiled before. "
        f"PSNR and SSIM after alignment; TRE is the median over slices. {machine_line(record['machine'])}"
    )
    return "\n\n".join(parts)


def _preset_table(record: Mapping[str, Any]) -> str:
    rows = []
    for name, case in record["cases"].items():
        points = points_of(case, record["base"])
        front = {points[n] for n in pareto_front([p.seconds for p in points], [p.psnr_db for p in points])}
        for point, (preset, row) in zip(points, case["presets"].items(), strict=False):
            cells = [
                name,
                f"`{preset}`",
                f"{row['seconds']:.1f}",
                f"{row['cpu_seconds']:.1f}",
                f"{row['peak_bytes'] / GB:.2f}",
                f"{row['n_gaussians']:,}",
                f"{row['psnr_db']:.2f}",
                f"{row['ssim']:.4f}",
                f"{row['tre_mm']:.2f}",
                "yes" if point in front else "no",
            ]
            rows.append(cells)
    head = [
        "case",
        "preset",
        "seconds",
        "CPU seconds",
        "peak memory, GB",
        "Gaussians",
        "PSNR, dB",
        "SSIM",
        "TRE, mm",
        "on the Pareto front",
    ]
    return markdown_table(head, rows)


def _check_table(record: Mapping[str, Any]) -> str:
    """Seconds and losses against their limits; values above are marked (!)."""
    rows = []
    for name, case in record["cases"].items():
        best = case["presets"].get(BEST)
        for preset, row in case["presets"].items():
            seconds, allowed = row["seconds"], ALLOWED_SECONDS[preset]
            cells = [name, f"`{preset}`", _judged(seconds, allowed, ".1f"), f"{allowed:.0f}"]
            if best is None or preset not in ALLOWED_LOSS_DB:
                cells += ["", ""]
            else:
                loss, most = best["psnr_db"] - row["psnr_db"], ALLOWED_LOSS_DB[preset]
                cells += [_judged(loss, most, ".2f"), f"{most:g}"]
            rows.append(cells)
    head = ["case", "preset", "seconds", "at most", f"dB less than `{BEST}`", "at most"]
    return markdown_table(head, rows)


def _judged(value: float, most: float, form: str) -> str:
    return f"{value:{form}}" + ("" if value <= most else " (!)")


def _stage_table(name: str, case: Mapping[str, Any]) -> str:
    """Wall and CPU seconds of each stage: one row per stage, two columns per preset."""
    presets = case["presets"]
    stages = list(dict.fromkeys(stage for row in presets.values() for stage in row["stages"]))
    head = [f"{name}: stage", *[f"`{p}` {kind}" for p in presets for kind in ("wall", "CPU")]]
    rows = [
        [stage, *[f"{row[key].get(stage, 0.0):.1f}" for row in presets.values() for key in KINDS]] for stage in stages
    ]
    return markdown_table(head, rows)


KINDS = ("stages", "stages_cpu")


def _sweep_table(name: str, case: Mapping[str, Any], base: str) -> str:
    offset = sweep_offset(case, base)
    rows = [
        [
            sweep,
            label + (f" (`{base}`)" if row["same_as_base"] else ""),
            f"{row['seconds'] + offset:.1f}",
            f"{row['stages']['fit to prior'] + row['stages']['fit to slices']:.1f}",
            f"{row['n_gaussians']:,}",
            f"{row['psnr_db']:.2f}",
            f"{row['ssim']:.4f}",
            f"{row['tre_mm']:.2f}",
        ]
        for sweep, variants in case["sweeps"].items()
        for label, row in variants.items()
    ]
    head = [f"{name}: sweep", "value", "seconds", "of them fitting", "Gaussians", "PSNR, dB", "SSIM", "TRE, mm"]
    return markdown_table(head, rows)
