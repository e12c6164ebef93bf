"""How many Gaussians a volume needs: PSNR against their number, by error bound and on a uniform lattice."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_synth.atlas import find_subjects, load_subject
from data_synth.phantom import fetal_brain_phantom
from g3r.bench.record import machine, markdown_table, put_between_markers, write_json
from g3r.errors import InputError
from g3r.fitting.adaptive_stage import AdaptiveSettings, fit_adaptive
from g3r.fitting.prior_stage import PriorStageSettings, VolumeTarget, fit_prior, solve_amplitudes_on
from g3r.gaussians import GaussianCloud, render
from g3r.gaussians.seeding import seed_cloud
from g3r.geometry import VolumeGrid
from studies.command import run_command
from studies.subjects import REPOSITORY, test_data_folder

Subject = tuple[NDArray[np.float32], NDArray[np.bool_], VolumeGrid]

BALL_RADIUS_MM = 40.0
BALL_MOST = 500
"""A uniform ball needs fewer Gaussians than this."""

ATLAS_SUBJECT = "sta27"
FINEST_MM = {"ball": 4.0}
"""Closest spacing of the adaptive clouds; 2.5 voxels for all others."""

BOUNDS = {"ball": (0.2, 0.1)}
USUAL_BOUNDS = (0.11, 0.085, 0.065)
LATTICE_MM = {"ball": (8.0, 6.0, 4.5)}
USUAL_LATTICE = (4.5, 3.6, 2.9, 2.4)


def ball(voxel_mm: float) -> Subject:
    """A ball of intensity 1 in its mask: sharp edge, voxels at the rim by the share that lies inside."""
    half = BALL_RADIUS_MM + 2
    grid = VolumeGrid.isotropic([-half] * 3, [half] * 3, voxel_mm)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), -1)
    inside_mm = BALL_RADIUS_MM - np.linalg.norm(grid.world(index), axis=-1)
    volume = np.clip(inside_mm / voxel_mm + 0.5, 0, 1).astype(np.float32)
    return volume, volume > 0, grid


def phantom(weeks: float, voxel_mm: float) -> Subject:
    """The built-in phantom, its signal in units of CSF."""
    made = fetal_brain_phantom(weeks, voxel_mm)
    return made.t2 / np.float32(1000), made.mask, VolumeGrid(made.t2.shape, made.affine)


def atlas(voxel_mm: float) -> Subject:
    """A subject of the atlas of the test data.

    Raises:
        InputError: no test data.
    """
    found = find_subjects(test_data_folder() / "atlas", include=[ATLAS_SUBJECT])
    truth = load_subject(found[0], spacing_mm=voxel_mm)
    return truth.data, truth.mask, VolumeGrid(truth.data.shape, truth.affine)


SUBJECTS: dict[str, Callable[[float], Subject]] = {
    "phantom, 22 weeks": lambda voxel: phantom(22, voxel),
    "phantom, 30 weeks": lambda voxel: phantom(30, voxel),
    "phantom, 37 weeks": lambda voxel: phantom(37, voxel),
    f"atlas, {ATLAS_SUBJECT}": atlas,
    "ball": ball,
}


def psnr_db(cloud: GaussianCloud, target: VolumeTarget) -> float:
    """PSNR of a cloud in the mask, over the largest value there; no affine fit."""
    inside = target.weight > 0
    error = (render(cloud, target.planes).numpy() - target.value)[inside]
    return float(-10 * np.log10((error**2).mean() / target.value[inside].max() ** 2))


def lattice_cloud(
    subject: Subject, spacing_mm: float, n_steps: int, amplitude_iterations: int, seed: int
) -> GaussianCloud:
    """A uniform lattice with as many optimiser and conjugate-gradient steps as the adaptive cloud had."""
    volume, mask, grid = subject
    target = VolumeTarget.of(volume, mask.astype(np.float32), grid)
    stage = replace(STAGE, n_steps=n_steps, amplitude_iterations=amplitude_iterations)
    cloud = seed_cloud(volume, mask, grid, spacing_mm)
    cloud, _ = fit_prior(cloud, target, stage, np.random.default_rng(seed))
    return solve_amplitudes_on(cloud, target, ADAPTIVE.amplitude_iterations)


STAGE = PriorStageSettings(scale_weight=0.0)
"""Nothing holds the sizes near their seeds, for both: the volume is all there is."""

ADAPTIVE = AdaptiveSettings()


def curves(subject: Subject, name: str, voxel_mm: float, seed: int = 0) -> dict[str, Any]:
    """Both curves of a subject: number of Gaussians, PSNR, CPU seconds."""
    volume, mask, grid = subject
    target = VolumeTarget.of(volume, mask.astype(np.float32), grid)
    finest = FINEST_MM.get(name, 2.5 * voxel_mm)
    adaptive = replace(ADAPTIVE, start=4.0) if name == "ball" else ADAPTIVE
    adaptive = replace(adaptive, last_steps=adaptive.round_steps)
    rows: dict[str, Any] = {"adaptive": [], "uniform": []}
    max_steps = 0
    for bound in BOUNDS.get(name, USUAL_BOUNDS):
        start = time.process_time()
        settings = replace(adaptive, bound=bound)
        cloud, done = fit_adaptive(
            volume,
            mask,
            grid,
            finest_spacing_mm=finest,
            settings=settings,
            stage=STAGE,
            rng=np.random.default_rng(seed),
        )
        seconds = round(time.process_time() - start, 2)
        row = {"n": len(cloud), "psnr_db": psnr_db(cloud, target), "cpu_seconds": seconds, **done.record()}
        rows["adaptive"].append(row)
        max_steps = max(max_steps, done.steps)
        _say(name, "adaptive", row)
    iterations = ADAPTIVE.amplitude_iterations * (max_steps // adaptive.round_steps)
    for spacing_mm in LATTICE_MM.get(name, USUAL_LATTICE):
        start = time.process_time()
        cloud = lattice_cloud(subject, spacing_mm, max_steps, iterations, seed)
        seconds = round(time.process_time() - start, 2)
        row = {"n": len(cloud), "psnr_db": psnr_db(cloud, target), "cpu_seconds": seconds}
        rows["uniform"].append(row | {"spacing_mm": spacing_mm})
        _say(name, "uniform", row)
    return rows | {"steps": max_steps, "n_voxels": int(mask.sum())}


def uniform_number(rows: Sequence[dict[str, Any]], psnr: float) -> float | None:
    """How many Gaussians the lattice needs for a PSNR: linear in log N between its points, None outside."""
    points = sorted((row["psnr_db"], np.log(row["n"])) for row in rows)
    level, log_n = zip(*points, strict=True)
    if not level[0] <= psnr <= level[-1]:
        return None
    return float(np.exp(np.interp(psnr, level, log_n)))


def table(record: dict[str, Any]) -> str:
    """The rows of the documentation: each adaptive cloud, and the lattice of equal PSNR."""
    lines = []
    for name, case in record["subjects"].items():
        for row in case["adaptive"]:
            needed = uniform_number(case["uniform"], row["psnr_db"])
            lines.append(
                [
                    name,
                    f"{row['bound']:g}",
                    f"{row['psnr_db']:.1f}",
                    row["n"],
                    "outside the curve" if needed is None else f"{needed:.0f}",
                    "-" if needed is None else f"{100 * row['n'] / needed:.0f} %",
                    f"{row['n_seeded']} + {row['n_added']} - {row['n_dropped']} - {row['n_merged']}",
                ]
            )
    head = [
        "volume",
        "bound",
        "PSNR, dB",
        "Gaussians",
        "uniform, equal PSNR",
        "ratio",
        "seeded + added - dropped - merged",
    ]
    text = markdown_table(head, lines)
    for name, reason in record["skipped"].items():
        text += f"\n\n{name}: left out, {reason}"
    return text


def draw(record: dict[str, Any], path: Path) -> None:
    """A panel per subject: PSNR against number of Gaussians, both ways."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    cases = record["subjects"]
    figure = Figure(figsize=(3.1 * len(cases), 3.3), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(cases), squeeze=False)[0]
    for axis, (name, case) in zip(axes, cases.items(), strict=True):
        for kind, colour, mark in (("adaptive", "#0072b2", "o"), ("uniform", "#d55e00", "s")):
            rows = sorted(case[kind], key=lambda row: row["n"])
            axis.plot([r["n"] for r in rows], [r["psnr_db"] for r in rows], marker=mark, color=colour, label=kind)
        axis.set_xscale("log")
        axis.set_title(name, fontsize=10)
        axis.set_xlabel("Gaussians")
        axis.grid(color="#e5e5e5", lw=0.6, which="both")
        axis.set_axisbelow(True)
    axes[0].set_ylabel("PSNR, dB")
    axes[0].legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _say(name: str, kind: str, row: dict[str, Any]) -> None:
    print(
        f"{name}: {kind}, {row['n']} Gaussians, {row['psnr_db']:.2f} dB, {row['cpu_seconds']} s",
        file=sys.stderr,
        flush=True,
    )


def run(options: argparse.Namespace) -> int:
    """Measure, print the table, write what was asked for."""
    unknown = sorted(set(options.subjects) - set(SUBJECTS))
    if unknown:
        raise InputError(f"--subjects {', '.join(unknown)}; expected some of: {'; '.join(SUBJECTS)}")
    record: dict[str, Any] = {"machine": machine(), "voxel_mm": options.voxel, "subjects": {}, "skipped": {}}
    path = options.output / "gaussian-count.json"
    if options.reuse and path.is_file():
        record["subjects"] = _finished(path, options.voxel)
    for name in options.subjects or SUBJECTS:
        if name in record["subjects"]:
            continue
        try:
            subject = SUBJECTS[name](options.voxel)
        except InputError as error:
            if not name.startswith("atlas"):
                raise
            record["skipped"][name] = "no test data (set G3R_TEST_DATA to the folder with atlas/)"
            print(f"gaussian_count: {name}: {error}", file=sys.stderr)
            continue
        record["subjects"][name] = curves(subject, name, options.voxel)
        write_json(path, record)
    text = table(record)
    print(text)
    if options.docs:
        put_between_markers(options.docs, "gaussian-count", text)
    if options.figure:
        draw(record, options.figure)
    return 0


def _finished(path: Path, voxel_mm: float) -> dict[str, Any]:
    """Subjects that an earlier run has measured.

    Raises:
        InputError: it measured them on other voxels.
    """
    found = json.loads(path.read_text(encoding="utf-8"))
    if found["voxel_mm"] != voxel_mm:
        raise InputError(f"{path}: voxels of {found['voxel_mm']} mm; expected {voxel_mm}; leave --reuse out")
    return {name: found["subjects"][name] for name in SUBJECTS if name in found["subjects"]}


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `python -m studies.tradeoff.gaussian_count`."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.tradeoff.gaussian_count",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--subjects", nargs="*", default=[], metavar="NAME", help="(none: all)")
    parser.add_argument("--voxel", type=float, default=1.0, help="of phantoms, ball and atlas, mm")
    parser.add_argument("--output", type=Path, default=REPOSITORY / "runs" / "bench", help="for the JSON")
    parser.add_argument("--reuse", action="store_true", help="take subjects that --output holds already")
    parser.add_argument("--docs", type=Path, metavar="FILE", help="also put the table between its markers")
    parser.add_argument("--figure", type=Path, metavar="PNG", help="also draw the curves")
    return run_command("gaussian_count", run, parser.parse_args(argv))


if __name__ == "__main__":
    raise SystemExit(main())
