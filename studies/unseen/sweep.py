"""`python -m studies.unseen.sweep`: heads of which part was never seen, reconstructed and compared with the truth."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from statistics import mean, median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_synth.uneven_coverage import emptied
from g3r.acquisition.coverage import UNSEEN_BELOW, coverage
from g3r.acquisition.images import Volume
from g3r.acquisition.stacks import Stack
from g3r.evaluation.align import resample
from g3r.evaluation.case import SimulatedCase
from g3r.geometry import RigidPose, VolumeGrid
from g3r.planning.presets import PRESETS
from g3r.reconstruct import GaussianReconstructor
from studies.harness import FITS, Record, Row, Study, Task
from studies.prior.volumes import slices_at_true_poses
from studies.runs import BAD_MEDIAN_MM, aligned
from studies.subjects import SubjectSpec, simulated_case
from studies.tables import Cell, details, new_figure, save_figure, table
from studies.unseen.fills import FILLS, filled_volumes

VOLUMES = (
    "crl-sta/sta24",
    "crl-sta/sta30",
    "crl-sta/sta34",
    "spina-bifida/sb27-operated",
    "spina-bifida/sb31-operated",
)
"""None was trained on; checkpoints were chosen by operated ones."""

FIRST_SEED, DEVELOPMENT_SEED = 63_000, 62_000
"""Seeds from the first belong to the published table; from the second they may be looked at before."""

N_SUBJECTS = 20
GOOD_VOLUME = 0.03
"""Error of the brain's volume, as a share, that is good."""


@dataclass(frozen=True)
class Hole:
    """What one stack misses: slices from one to another share of its masked ones."""

    stack: int
    first: float
    last: float


def hole_of(n: int, rng: np.random.Generator) -> tuple[int, tuple[Hole, ...]]:
    """Number of stacks of subject n, and what they miss: nothing, runs of 1 to 8 slices, or fields of view that end.

    Args:
        n: number of the subject.
        rng: of the subject.
    """
    n_stacks = 1 if n % 2 == 0 else 3
    kind = n % 4
    if n % 10 == 9:
        return n_stacks, ()
    if kind in (0, 1):
        places = rng.uniform(0.15, 0.7, n_stacks)
        return n_stacks, tuple(Hole(k, p, -float(rng.integers(1, 9))) for k, p in enumerate(places))
    share, at_end = rng.uniform(0.2, 0.45), rng.random() < 0.5
    return n_stacks, tuple(
        Hole(k, 1 - share, 1.0) if at_end else Hole(k, 0.0, share) for k in range(n_stacks) if k == 0 or kind == 3
    )


def with_holes(stacks: tuple[Stack, ...], holes: tuple[Hole, ...]) -> tuple[Stack, ...]:
    """The stacks without the slices of the holes; a negative end of a hole is a number of slices."""
    result = list(stacks)
    for hole in holes:
        masked = np.flatnonzero(stacks[hole.stack].mask.any((0, 1)))
        first = round(hole.first * len(masked))
        n = int(-hole.last) if hole.last < 0 else round(hole.last * len(masked)) - first
        if n > 0:
            last = min(first + n, len(masked)) - 1
            result[hole.stack] = emptied(stacks[hole.stack], int(masked[first]), int(masked[last]) + 1)
    return tuple(result)


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """A measurement per subject."""
    seed = DEVELOPMENT_SEED if options.development else FIRST_SEED
    for n in range(options.subjects):
        spec = SubjectSpec(volume=VOLUMES[n % len(VOLUMES)], motion=("mild", "moderate")[(n // 2) % 2], seed=seed + n)
        n_stacks, holes = hole_of(n, np.random.default_rng([seed, n]))
        yield Task(f"{spec.name}, {n_stacks} stacks", measure, (spec, n_stacks, holes, options))


def measure(spec: SubjectSpec, n_stacks: int, holes: tuple[Hole, ...], options: argparse.Namespace) -> Row:
    """Reconstruct one subject, and score seen and unseen brain of every fill.

    Args:
        spec: the subject.
        n_stacks: of its stacks.
        holes: what they miss.
        options: of the command.
    """
    case = simulated_case(spec, options.cache, n_stacks)
    case = replace(case, stacks=with_holes(case.stacks, holes))
    reconstructor = GaussianReconstructor(options.ckpt, PRESETS[options.preset])
    start = time.perf_counter()
    poses = reconstructor.register_stacks(case.stacks)
    result = reconstructor.reconstruct(case.stacks, poses)
    seconds = time.perf_counter() - start
    error = case.pose_error(result.slices)
    assert reconstructor.prior is not None
    fills, made_of = filled_volumes(poses, reconstructor.prior, reconstructor.prior.voxel_mm)
    volumes: dict[str, tuple[NDArray[np.float32], VolumeGrid]] = {
        **{name: (values, made_of.grid) for name, values in fills.items()},
        "V_prior": (result.prior, result.prior_grid),
        "volume": (result.volume, result.grid),
    }
    unseen = truly_unseen(case, n_stacks)
    scores = {name: scored(case, *volumes[name], error.common, unseen) for name in FILLS}
    brain_mm3 = float(result.mask.sum()) * result.grid.voxel_volume_mm3
    true_mm3 = float(case.truth_mask.sum()) * case.truth.grid.voxel_volume_mm3
    return {
        "n_stacks": n_stacks,
        "holes": [vars(hole) for hole in holes],
        "unseen_share": float(unseen.sum()) / float(case.truth_mask.sum()),
        "stated_share": result.record.unseen.share if result.record.unseen else 0.0,
        "median_mm": error.median_mm,
        "volume_error": brain_mm3 / true_mm3 - 1,
        "scores": scores,
        "calibration": calibration_ratio(case, result, error.common),
        "warned": bool(result.record.warnings),
        "reliable": result.record.registration.reliable if result.record.registration else None,
        "seconds": round(seconds, 1),
    }


def truly_unseen(case: SimulatedCase, n_stacks: int) -> NDArray[np.bool_]:
    """Voxels of the true brain that no slice saw at its true pose."""
    density = coverage(slices_at_true_poses(case, n_stacks), case.truth.grid)
    return case.truth_mask & (density < UNSEEN_BELOW)


def scored(
    case: SimulatedCase, values: NDArray[np.float32], grid: VolumeGrid, common: RigidPose, unseen: NDArray[np.bool_]
) -> dict[str, float]:
    """PSNR (dB) of the whole brain, of its seen and of its unseen part, after alignment and one gain and offset.

    Args:
        case: with the truth.
        values: [I, J, K] a volume.
        grid: its grid.
        common: motion of all slices to the truth.
        unseen: on the truth's grid.
    """
    alignment = aligned(case, values, grid, common).alignment
    assert alignment is not None
    moved = resample(
        Volume(values, grid.moved(common).affine, "volume"), case.truth.grid, alignment.volume_from_reference
    )
    truth, brain = case.truth.data, case.truth_mask
    seen = brain & ~unseen
    design = np.stack([moved[seen], np.ones(int(seen.sum()))], axis=1)
    gain, offset = np.linalg.lstsq(design, truth[seen], rcond=None)[0]
    squared = (gain * moved + offset - truth) ** 2
    peak = float(np.percentile(truth[brain], 99.9))
    parts = {"whole": brain, "seen": seen, "unseen": unseen}
    return {
        name: round(float(10 * np.log10(peak**2 / squared[part].mean())), 3)
        for name, part in parts.items()
        if part.sum() > 100
    }


def calibration_ratio(case: SimulatedCase, result: Any, common: RigidPose) -> dict[str, float]:
    """Stated expected error over the true mean error, in the seen and in the unseen part of the result.

    Args:
        case: with the truth.
        result: of the reconstruction.
        common: motion of all slices to the truth.
    """
    alignment = aligned(case, result.volume, result.grid, common).alignment
    assert alignment is not None
    assert result.uncertainty is not None
    truth_from_result = alignment.volume_from_reference.inverse() @ common
    truth = resample(case.truth, result.grid, truth_from_result)
    inside = Volume(case.truth_mask.astype(np.float32), case.truth.affine, "mask")
    both = result.mask & (resample(inside, result.grid, truth_from_result) > 0.5)
    seen = both & ~result.unseen
    factor = float(result.volume[seen].mean()) / float(truth[seen].mean())
    error = np.abs(result.volume - factor * truth)
    parts = {"seen": seen, "unseen": both & result.unseen}
    return {
        name: round(float(result.uncertainty[part].mean() / error[part].mean()), 3)
        for name, part in parts.items()
        if part.sum() > 100
    }


def line(key: str, row: Row) -> str:
    """A finished subject."""
    unseen = ", ".join(f"{name} {row['scores'][name].get('unseen', float('nan')):.1f}" for name in FILLS)
    return (
        f"{key}: {row['unseen_share']:.1%} unseen, TRE {row['median_mm']:.2f} mm, brain {row['volume_error']:+.1%}, "
        f"unseen dB: {unseen}, {row['seconds']:.0f} s{', warned' * row['warned']}"
    )


def tables(record: Record) -> dict[str, str]:
    """What holds of all subjects, and each."""
    rows = list(record["rows"].values())
    n = len(rows)
    good_volume = sum(abs(row["volume_error"]) <= GOOD_VOLUME for row in rows)
    bad = [row for row in rows if not row["median_mm"] < BAD_MEDIAN_MM]
    silent = sum(not row["warned"] for row in bad)
    with_hole = [row for row in rows if "unseen" in row["scores"]["volume"]]
    text = (
        f"{n} subjects, {len(with_hole)} with an unseen part. Brain volume within {GOOD_VOLUME:.0%} of the truth: "
        f"{good_volume} of {n}. Median TRE under {BAD_MEDIAN_MM:g} mm: {n - len(bad)} of {n}; of the others "
        f"{silent} without a warning."
    )
    means: list[Mapping[str, Any]] = [
        {
            "name": name,
            "unseen": mean(row["scores"][name]["unseen"] for row in with_hole),
            "whole": mean(row["scores"][name]["whole"] for row in with_hole),
        }
        for name in (FILLS if with_hole else ())
    ]
    by_fill = table(means, {"fill": "{name}", "unseen part, dB": "{unseen:.2f}", "whole brain, dB": "{whole:.2f}"})
    ratios = [row["calibration"]["unseen"] for row in with_hole if "unseen" in row["calibration"]]
    stated = f"Stated over true error in the unseen part: median {median(ratios):.2f}." if ratios else ""
    each = table(({"name": name, **row} for name, row in record["rows"].items()), EACH)
    return {"unseen-sweep": "\n\n".join([text, by_fill, stated, details("Every subject", each)])}


def _unseen(name: str) -> Cell:
    return lambda row: f"{row['scores'][name]['unseen']:.1f}" if "unseen" in row["scores"][name] else "-"


def _ratio(row: Row) -> str:
    return f"{row['calibration']['unseen']:.2f}" if "unseen" in row["calibration"] else "-"


EACH: dict[str, Cell] = {
    "subject": "{name}",
    "unseen": "{unseen_share:.1%}",
    "stated": "{stated_share:.1%}",
    "TRE mm": "{median_mm:.2f}",
    "brain volume": "{volume_error:+.1%}",
    **{f"{name}, unseen dB": _unseen(name) for name in FILLS},
    "whole dB": "{scores[volume][whole]:.2f}",
    "stated / true error": _ratio,
    "warned": lambda row: "yes" if row["warned"] else "-",
    "s": "{seconds:.0f}",
}


def draw(record: Record, options: argparse.Namespace) -> None:
    """PSNR of the unseen part by fill, a line per subject."""
    rows = [row for row in record["rows"].values() if "unseen" in row["scores"]["volume"]]
    figure = new_figure((6.4, 4.2))
    panel = figure.subplots()
    for row in rows:
        values = [row["scores"][name]["unseen"] for name in FILLS]
        panel.plot(range(len(FILLS)), values, color="#9a9a9a", linewidth=0.8, marker=".")
    if rows:
        means = [mean(row["scores"][name]["unseen"] for row in rows) for name in FILLS]
        panel.plot(range(len(FILLS)), means, color="#c0392b", linewidth=2, marker="o", label="mean")
        panel.legend(frameon=False)
    panel.set_xticks(range(len(FILLS)), FILLS)
    panel.set_ylabel("PSNR of the unseen part (dB)")
    save_figure(figure, options.figure)


STUDY = Study(
    name="unseen.sweep",
    about="Simulate heads of which part was never seen, and measure poses, brain volume and what fills the hole.",
    document="unseen.md",
    picture="unseen.png",
    shared=(*FITS, "--jobs", "--cache", "--development"),
    options={"--subjects": {"type": int, "default": N_SUBJECTS, "metavar": "N", "help": "how many"}},
    tasks=tasks,
    line=line,
    tables=tables,
    figure=draw,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
