"""`python -m studies.motion.layers`: gain and cost of each layer of registration on known cases."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from studies.harness import FITS, Record, Row, Study, Task
from studies.motion.figure import draw_slice_errors, jerk_slices
from studies.runs import header_error, run
from studies.subjects import case_folders, read_case
from studies.tables import table

Options = Mapping[str, Any]

_ONE_START = {
    "registration.template": False,
    "registration.network": False,
    "registration.stacks": False,
    "registration.segments": False,
    "registration.n_rounds": 0,
}


@dataclass(frozen=True)
class Layer:
    """A layer of registration, measured after it and all earlier layers.

    Args:
        name: in tables and figures.
        options: settings with which registration ends after this layer (see `g3r.planning.presets.changed`).
        full: whether the layer is part of the fit, which requires the whole reconstruction.
    """

    name: str
    options: Options = field(default_factory=dict)
    full: bool = False


LAYERS = (
    Layer("template", {**_ONE_START, "registration.template": True}),
    Layer("network", {**_ONE_START, "registration.network": True}),
    Layer("stacks", {**_ONE_START, "registration.stacks": True}),
    Layer("best start", {"registration.segments": False, "registration.n_rounds": 0}),
    Layer("segments", {"registration.n_rounds": 0}),
    Layer("slices"),
    Layer("joint", full=True),
)
"""Layers in their order after the headers. Each of the first three alone competes with the headers."""

WITHOUT: dict[str, Options] = {
    "template": {"registration.template": False},
    "network": {"registration.network": False},
    "stacks": {"registration.stacks": False},
    "segments": {"registration.segments": False},
    "slices": {"registration.n_rounds": 0},
    "joint": {"slice_stage.optimise_poses": False},
    "slices and joint": {"registration.n_rounds": 0, "slice_stage.optimise_poses": False},
    "bias field": {"slice_stage.optimise_bias_field": False},
}
"""Layers switched off, one at a time, in a whole reconstruction."""


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per case."""
    for folder in case_folders(options.cases):
        yield Task(folder.name, measure, (folder, options))


def measure(folder: Path, options: argparse.Namespace) -> Row:
    """Errors after each layer, and scores of the product and of the product without each layer."""
    case = read_case(folder)
    header = header_error(case)
    layers: dict[str, Any] = {"headers": {**header.figures(), "per_slice_mm": _listed(header.per_slice_mm)}}
    row: Row = {}
    for layer in LAYERS:
        error, row = run(case, options, layer.options, full=layer.full)
        layers[layer.name] = {**row, "per_slice_mm": _listed(error.per_slice_mm)}
        _say(case.name, f"after {layer.name}", row)
    without = {"everything": row}  # the last layer is the product
    for name, changes in ({} if options.no_without else WITHOUT).items():
        _, without[name] = run(case, options, changes, full=True)
        _say(case.name, f"without {name}", without[name])
    return {
        "layers": layers,
        "without": without,
        "n_slices": [stack.image.shape[2] for stack in case.stacks],
        "jerks": jerk_slices(case.true, case.points_mm),
    }


def _listed(per_slice_mm: Mapping[tuple[int, int], float]) -> list[list[float]]:
    return [[stack, k, round(error, 4)] for (stack, k), error in per_slice_mm.items()]


def _say(case: str, what: str, row: Row) -> None:
    psnr = f", {row['psnr_db']:.2f} dB" if "psnr_db" in row else ""
    tre = f"TRE {row['median_mm']:.2f} / {row['p90_mm']:.2f} mm"
    print(f"{case}, {what}: {tre}{psnr}, {row['seconds']:.0f} s", flush=True)


def tables(record: Record) -> dict[str, str]:
    """Tables of errors and seconds after each layer, and of volumes without one layer."""
    rows = [{"case": case, **row} for case, row in record["rows"].items()]
    layers = list(dict.fromkeys(name for row in rows for name in row["layers"]))
    variants = list(dict.fromkeys(name for row in rows for name in row["without"]))

    def cells(part: str, form: str, heads: Mapping[str, str]) -> str:
        of = {head: form.replace("{", f"{{{part}[{name}]") for name, head in heads.items()}
        return table(rows, {"case": "{case}", **of})

    titles = {name: name if name == "everything" else f"without {name}" for name in variants}
    parts = [
        f"Preset `{record['preset']}`, {record['threads']} threads. "
        "TRE after each layer, median / 90th percentile over slices in mm:",
        cells("layers", "{[median_mm]:.2f} / {[p90_mm]:.2f}", {name: name for name in layers}),
        "Wall seconds from the stacks to the end of that layer (of the last: to the volume):",
        cells("layers", "{[seconds]:.0f}", {name: name for name in layers[1:]}),
        "PSNR of the volume in dB (and median TRE in mm) with everything, and without one thing:",
        cells("without", "{[psnr_db]:.2f} ({[median_mm]:.2f})", titles),
    ]
    return {"layers": "\n\n".join(parts)}


STUDY = Study(
    name="motion.layers",
    about="Pose errors after each layer of registration, and the volume without a layer, on the cases.",
    document="motion.md",
    picture="motion-tre.png",
    shared=(*FITS, "--cases"),
    options={"--no-without": {"action": "store_true", "help": "skip the runs without a layer"}},
    settings=lambda options: {"without": not options.no_without},
    tasks=tasks,
    tables=tables,
    figure=lambda record, options: draw_slice_errors(record["rows"], options.figure),
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
