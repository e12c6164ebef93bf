"""`python -m studies.tradeoff.slice_profile`: estimation of slice profiles of known width by held-out slices."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from data_synth.simulator import StackSettings
from data_synth.slice_profile import Profile, profile_deviation
from g3r.acquisition.psf import FWHM_PER_SIGMA
from g3r.planning.presets import PRESETS, changed
from g3r.reconstruct import GaussianReconstructor
from studies.harness import Record, Row, Study, Task
from studies.runs import aligned, figures
from studies.subjects import SizedSubject, simulated_case
from studies.tables import Cell, table

PIXEL_MM, STATED_MM = 1.0, 3.0
"""Pixel size, and the thickness that is stated to the reconstruction."""

HEADS = (("crl-sta/sta27", 72_001), ("crl-sta/sta31", 72_002))
"""Development heads, and the seed of each."""

EQUAL = (1.0, 1.0, 1.0)

SLICES: tuple[tuple[Profile, tuple[float, ...]], ...] = (
    ("gaussian", EQUAL),
    ("box", EQUAL),
    ("sinc", EQUAL),
    ("gaussian", (0.75,) * 3),
    ("gaussian", (1.25,) * 3),
    ("gaussian", (0.75, 1.0, 1.25)),
    ("box", (1.25, 1.0, 0.75)),
)
"""Profile, and ratio of the true to the stated thickness of each stack."""

ONE_FIT = {"pose_rounds.more_stacks": 0, "prior_views": 1, "share_probes": 1}

MODELS: dict[str, Mapping[str, Any]] = {
    "nominal": {"held_out": None, "slice_model.through_plane": 1.0},
    "0.95": {"held_out": None},
    "found": {},
}
"""Changes of `balanced` on one registration: profile as stated, as in `fast`, and as estimated by held-out slices."""


@dataclass(frozen=True, kw_only=True)
class ProfiledSubject(SizedSubject):
    """A subject whose slices are thicker or thinner than stated, with the slice spacing unchanged.

    Args:
        profile: through the slice.
        true_width: ratio of the true thickness of each stack to `thickness_mm`.
    """

    profile: Profile
    true_width: tuple[float, ...]

    def acquisition(self, n_stacks: int) -> list[StackSettings]:
        """Acquisition settings of its stacks."""
        usual = super().acquisition(n_stacks)
        return [
            replace(
                one,
                profile=self.profile,
                thickness_mm=self.thickness_mm * width,
                gap_mm=self.thickness_mm * (1 - width),
            )
            for one, width in zip(usual, self.true_width, strict=True)
        ]


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per head and kind of slices."""
    for volume, seed in HEADS:
        for profile, widths in SLICES:
            name = "profile-" + "-".join([profile, *(f"{width:g}" for width in widths), str(seed)])
            spec = ProfiledSubject(
                name=name,
                volume=volume,
                motion="mild",
                seed=seed,
                pixel_mm=PIXEL_MM,
                thickness_mm=STATED_MM,
                profile=profile,
                true_width=widths,
            )
            yield Task(name, measure, (spec, options))


def measure(spec: ProfiledSubject, options: argparse.Namespace) -> Row:
    """Estimated widths, and the volume with and without them, on one registration.

    Args:
        spec: of the subject.
        options: of the command.
    """
    case = simulated_case(spec, options.cache)
    stacks = [replace(stack, thickness_mm=STATED_MM) for stack in case.stacks]
    usual = changed(PRESETS["balanced"], ONE_FIT)
    poses = GaussianReconstructor(options.ckpt, PRESETS["fast"]).register_stacks(stacks)
    scores, found = {}, None
    for name, changes in MODELS.items():
        result = GaussianReconstructor(options.ckpt, changed(usual, changes)).reconstruct(stacks, poses)
        scores[name] = figures(aligned(case, result.volume, result.grid, case.pose_error(result.slices).common).scores)
        found = result.record.held_out or found
    assert found is not None
    return {
        "head": spec.volume.rsplit("/", 1)[-1],
        "profile": spec.profile,
        "true": [round(equivalent_width(spec.profile, width), 2) for width in spec.true_width],
        "mean": found.mean_width,
        "taken": found.widths,
        "scores": scores,
    }


def equivalent_width(profile: Profile, width: float) -> float:
    """Width of the Gaussian of the same variance, relative to the nominal width for the stated thickness."""
    return float(FWHM_PER_SIGMA * profile_deviation(profile) * width)


def line(key: str, row: Row) -> str:
    """Progress line of a finished subject."""
    scores = ", ".join(f"{name} {found['psnr_db']:.2f}" for name, found in row["scores"].items())
    return f"{key}: true {row['true']}, mean {row['mean']}, taken {row['taken']}; {scores} dB"


def tables(record: Record) -> dict[str, str]:
    """A row per subject: true widths, mean of the estimates, widths that were used, and PSNR."""

    def listed(widths: list[float] | None) -> str:
        return "not found" if widths is None else ", ".join(f"{width:.2f}" for width in widths)

    rows = [
        row
        | {
            "true mean": f"{np.exp(np.log(row['true']).mean()):.2f}",
            "found mean": "not found" if row["mean"] is None else f"{row['mean']:.2f}",
            "true text": listed(row["true"]),
            "taken text": listed(row["taken"]),
        }
        for row in record["rows"].values()
    ]
    columns: dict[str, Cell] = {
        "head": "{head}",
        "profile": "{profile}",
        "true widths": "{true text}",
        "their mean": "{true mean}",
        "mean found": "{found mean}",
        "widths taken": "{taken text}",
        **{f"dB, {name}": f"{{scores[{name}][psnr_db]:.2f}}" for name in MODELS},
    }
    return {"slice-profile": f"Weights {record['weights']}.\n\n{table(rows, columns)}"}


STUDY = Study(
    name="tradeoff.slice_profile",
    about="Stacks of box, Gaussian and truncated-sinc profiles whose widths are known: what held-out slices find, and "
    "what it brings.",
    document="tradeoff.md",
    shared=("--ckpt", "--threads", "--jobs", "--cache"),
    tasks=tasks,
    line=line,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
