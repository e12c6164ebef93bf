"""`python -m studies.tradeoff.gaussian_count`: how many Gaussians a volume needs, by error bound and on a lattice."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_synth.atlas import find_subjects, load_subject
from data_synth.phantom import fetal_brain_phantom
from g3r.errors import InputError
from g3r.fitting.adaptive_stage import AdaptiveSettings, fit_adaptive
from g3r.fitting.prior_stage import PriorStageSettings, VolumeTarget, fit_prior, solve_amplitudes_on
from g3r.gaussians import GaussianCloud, render
from g3r.gaussians.seeding import seed_cloud
from g3r.geometry import VolumeGrid
from studies.harness import Record, Row, Study, Task
from studies.subjects import data_folder
from studies.tables import new_figure, save_figure, table

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
    """A ball of intensity 1 in its mask: sharp edge, voxels at the rim by the share inside."""
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
    found = find_subjects(data_folder("atlas"), include=[ATLAS_SUBJECT])
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
    """A uniform lattice with as many optimiser and conjugate-gradient steps as the adaptive cloud had.

    Args:
        subject: volume [I, J, K], mask and grid.
        spacing_mm: of the lattice.
        n_steps: of the optimiser.
        amplitude_iterations: of conjugate gradients.
        seed: of the planes that steps look at.
    """
    volume, mask, grid = subject
    target = VolumeTarget.of(volume, mask.astype(np.float32), grid)
    stage = replace(STAGE, n_steps=n_steps, amplitude_iterations=amplitude_iterations)
    cloud = seed_cloud(volume, mask, grid, spacing_mm)
    cloud, _ = fit_prior(cloud, target, stage, np.random.default_rng(seed))
    return solve_amplitudes_on(cloud, target, ADAPTIVE.amplitude_iterations)


STAGE = PriorStageSettings(scale_weight=0.0)
"""Nothing holds the sizes near their seeds, for both: the volume is all there is."""

ADAPTIVE = AdaptiveSettings()


def _curves(subject: Subject, name: str, voxel_mm: float, seed: int = 0) -> dict[str, Any]:
    """Both curves of a subject: number of Gaussians, PSNR, CPU seconds."""
    volume, mask, grid = subject
    target = VolumeTarget.of(volume, mask.astype(np.float32), grid)
    finest = FINEST_MM.get(name, 2.5 * voxel_mm)
    adaptive = replace(ADAPTIVE, start=4.0) if name == "ball" else ADAPTIVE
    adaptive = replace(adaptive, last_steps=adaptive.round_steps)
    rows: dict[str, Any] = {"adaptive": [], "uniform": []}

    def keep(kind: str, cloud: GaussianCloud, start: float, more: Row) -> None:
        seconds = round(time.process_time() - start, 2)
        row = {"n": len(cloud), "psnr_db": psnr_db(cloud, target), "cpu_seconds": seconds, **more}
        rows[kind].append(row)
        print(
            f"{name}: {kind}, {len(cloud)} Gaussians, {row['psnr_db']:.2f} dB, {seconds} s", file=sys.stderr, flush=True
        )

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
        keep("adaptive", cloud, start, done.record())
        max_steps = max(max_steps, done.steps)
    iterations = ADAPTIVE.amplitude_iterations * (max_steps // adaptive.round_steps)
    for spacing_mm in LATTICE_MM.get(name, USUAL_LATTICE):
        start = time.process_time()
        cloud = lattice_cloud(subject, spacing_mm, max_steps, iterations, seed)
        keep("uniform", cloud, start, {"spacing_mm": spacing_mm})
    return rows | {"steps": max_steps, "n_voxels": int(mask.sum())}


def uniform_number(rows: Sequence[dict[str, Any]], psnr: float) -> float | None:
    """How many Gaussians the lattice needs for a PSNR: linear in log N between its points, None outside."""
    points = sorted((row["psnr_db"], np.log(row["n"])) for row in rows)
    level, log_n = zip(*points, strict=True)
    if not level[0] <= psnr <= level[-1]:
        return None
    return float(np.exp(np.interp(psnr, level, log_n)))


def tables(record: Record) -> dict[str, str]:
    """Each adaptive cloud, and the lattice of equal PSNR."""
    rows = []
    for name, case in record["rows"].items():
        for row in case.get("adaptive", []):
            needed = uniform_number(case["uniform"], row["psnr_db"])
            known = {} if needed is None else {"needed": needed, "percent": 100 * row["n"] / needed}
            rows.append({"name": name, **row, **known})
    columns: dict[str, Any] = {
        "volume": "{name}",
        "bound": "{bound:g}",
        "PSNR, dB": "{psnr_db:.1f}",
        "Gaussians": "{n}",
        "uniform, equal PSNR": lambda row: f"{row['needed']:.0f}" if "needed" in row else "outside the curve",
        "ratio": lambda row: f"{row['percent']:.0f} %" if "percent" in row else "-",
        "seeded + added - dropped - merged": "{n_seeded} + {n_added} - {n_dropped} - {n_merged}",
    }
    skipped = [f"{name}: left out, {row['skipped']}" for name, row in record["rows"].items() if "skipped" in row]
    return {"gaussian-count": "\n\n".join([table(rows, columns), *skipped])}


def draw(record: Record, options: argparse.Namespace) -> None:
    """A panel per subject: PSNR against number of Gaussians, both ways."""
    cases = {name: row for name, row in record["rows"].items() if "skipped" not in row}
    figure = new_figure((3.1 * len(cases), 3.3))
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
    save_figure(figure, options.figure)


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """Both curves of every subject."""
    for name in options.subjects or SUBJECTS:
        yield Task(name, measure, (name, options.voxel))


def measure(name: str, voxel_mm: float) -> Row:
    """Both curves of a subject; that of the atlas needs the test data."""
    try:
        subject = SUBJECTS[name](voxel_mm)
    except InputError:
        if not name.startswith("atlas"):
            raise
        return {"skipped": "no test data (set G3R_TEST_DATA to the folder with atlas/)"}
    return _curves(subject, name, voxel_mm)


STUDY = Study(
    name="tradeoff.gaussian_count",
    about="How many Gaussians a volume needs: PSNR against their number, by error bound and on a uniform lattice.",
    document="tradeoff.md",
    picture="gaussian-count.png",
    shared=("--threads",),
    options={
        "--subjects": {"nargs": "*", "choices": SUBJECTS, "default": [], "metavar": "NAME", "help": "(none: all)"},
        "--voxel": {"type": float, "default": 1.0, "help": "of phantoms, ball and atlas, mm"},
    },
    settings=lambda options: {"voxel_mm": options.voxel},
    tasks=tasks,
    tables=tables,
    figure=draw,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
