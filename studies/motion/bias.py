"""`python -m studies.motion.bias`: poses and volume under a bias field, estimated or ignored."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from typing import Any

from g3r.planning.presets import PRESETS, changed
from studies.harness import FITS, Record, Row, Study, Task, positive
from studies.runs import run
from studies.subjects import SubjectSpec, simulated_case
from studies.tables import Cell, table

BIASES = (0.05, 0.15)
VOLUMES = ("crl-sta/sta30", "spina-bifida/sb32-operated")
"""A week excluded from training, and a volume that training used only for the choice of checkpoints."""

SEED = 33_000
"""First seed of this study. A volume has the same seed at every strength of the bias field, so that motion, noise and
the shape of the field are the same."""

VARIANTS: dict[str, Mapping[str, Any]] = {"estimated": {}, "not estimated": {"slice_stage.optimise_bias_field": False}}
"""Variants that are compared, with changes of the settings as for `g3r.planning.presets.changed`."""


def specs(n_repeats: int = 1) -> list[SubjectSpec]:
    """The subjects: each volume with moderate motion, `n_repeats` times, at each strength of the bias field."""
    return [
        SubjectSpec(
            name=f"bias-{bias:.2f}-{volume.rsplit('/', 1)[-1]}-{number}",
            volume=volume,
            motion="moderate",
            seed=SEED + n + len(VOLUMES) * number,
            bias=bias,
            stretch=0.0,
        )
        for n, volume in enumerate(VOLUMES)
        for number in range(n_repeats)
        for bias in BIASES
    ]


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per variant of every subject."""
    settings = PRESETS[options.preset]
    for spec in specs(options.repeats):
        for variant, changes in VARIANTS.items():
            chosen = changed(settings, changes)
            if options.motion_only and chosen != settings and chosen.registration == settings.registration:
                continue  # registration would give the same result
            # registration alone has no fit, so unchanged settings do not mean that the field is estimated
            label = "-" if options.motion_only and not changes else variant
            yield Task(f"{spec.name}, {label}", measure, (spec, label, changes, options))


def measure(spec: SubjectSpec, label: str, changes: Mapping[str, Any], options: argparse.Namespace) -> Row:
    """Measure one variant of one subject.

    Args:
        spec: of the subject.
        label: of the variant.
        changes: settings that differ from the preset, by dotted name.
        options: of the command.
    """
    _, row = run(simulated_case(spec, options.cache), options, changes, full=not options.motion_only)
    return {"volume": spec.volume, "seed": spec.seed, "bias": spec.bias, "bias_field": label, **row}


def tables(record: Record) -> dict[str, str]:
    """A row per run."""
    columns: dict[str, Cell] = {
        "volume": "{volume}",
        "seed": "{seed}",
        "bias": "{bias:.2f}",
        "bias field": "{bias_field}",
        "TRE median mm": "{median_mm:.2f}",
        "TRE p90 mm": "{p90_mm:.2f}",
        "PSNR dB": "{psnr_db:.2f}",
        "SSIM": "{ssim:.3f}",
        "warned": lambda row: "yes" if row["warned"] else "-",
        "wall s": "{seconds:.0f}",
    }
    text = table(record["rows"].values(), columns)
    return {"bias": f"Preset `{record['preset']}`, {record['threads']} threads.\n\n{text}"}


STUDY = Study(
    name="motion.bias",
    about="Reconstruct subjects with a weak and a strong bias field, estimated or ignored.",
    document="motion.md",
    shared=(*FITS, "--cache"),
    options={
        "--repeats": {"type": positive, "default": 1, "metavar": "N", "help": "subjects of each volume"},
        "--motion-only": {"action": "store_true", "help": "registration alone, no volume"},
    },
    settings=lambda options: {"motion_only": options.motion_only},
    tasks=tasks,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
