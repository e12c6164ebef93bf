"""`python -m studies.motion.layers`: what each layer of registration brings and costs on known cases."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g3r.bench.record import markdown_table, put_between_markers, write_json, write_text
from g3r.errors import InputError
from studies.command import parser_of, run_command

if TYPE_CHECKING:
    from g3r.evaluation.case import SimulatedCase
    from g3r.planning.presets import ReconstructionSettings
    from studies.runs import Run

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
    """One more layer than the row before.

    Args:
        name: in tables and figures.
        options: settings with which registration ends after this layer (see `g3r.planning.presets.changed`).
        full: whether the layer is part of the fit, so that the whole reconstruction is run.
    """

    name: str
    options: Options = field(default_factory=dict)
    full: bool = False


LAYERS = (
    Layer("template", {**_ONE_START, "registration.template": True}),
    Layer("network", {**_ONE_START, "registration.network": True}),
    Layer("stacks", {**_ONE_START, "registration.stacks": True}),
    Layer("best start", {"registration.segments": False, "registration.n_rounds": 0}),
    Layer("runs", {"registration.n_rounds": 0}),
    Layer("slices"),
    Layer("joint", full=True),
)
"""In the order in which they follow on the headers; the first three each compete with the headers alone."""

WITHOUT: dict[str, Options] = {
    "template": {"registration.template": False},
    "network": {"registration.network": False},
    "stacks": {"registration.stacks": False},
    "runs": {"registration.segments": False},
    "slices": {"registration.n_rounds": 0},
    "joint": {"slice_stage.optimise_poses": False},
    "slices and joint": {"registration.n_rounds": 0, "slice_stage.optimise_poses": False},
    "shading": {"slice_stage.optimise_bias_field": False},
}
"""What is switched off, one at a time, in a whole reconstruction."""

THICKNESS_MM = {"sb28-mild-gap": 3.0}
"""Cases whose slices are thinner than their distance and that have no simulation.json to say so."""

ORDER = ("*-none", "*-mild*", "*-moderate", "*-severe", "*-single")

DEFAULT_FOLDER = Path("runs") / "bench" / "motion-layers"


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = parser_of(
        "motion_layers",
        "Pose errors after each layer of registration, and the volume with a layer left out, on "
        "the cases in the folder that G3R_TEST_DATA names.",
        DEFAULT_FOLDER,
    )
    parser.add_argument("--cases", nargs="+", metavar="GLOB", default=["*"], help="which of them")
    parser.add_argument("--no-without", action="store_true", help="skip the runs with a layer left out")
    parser.add_argument("--keep", action="store_true", help="keep cases that layers.json holds already")
    parser.add_argument("--figure", type=Path, metavar="PNG", help="also draw the error of every slice")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = build_parser().parse_args(argv)
    return run_command("motion_layers", _run, options)


def _run(options: argparse.Namespace) -> int:
    from g3r.bench.record import available_cores, machine, use_threads
    from g3r.evaluation.case import load_case
    from studies.runs import preset_settings
    from studies.subjects import test_data_folder

    folders = case_folders(test_data_folder() / "cases", options.cases)
    settings = preset_settings(options.preset)
    threads = options.threads or available_cores()
    use_threads(threads)
    path = options.output / "layers.json"
    record: dict[str, Any] = {"preset": options.preset, "threads": threads, "machine": machine(), "cases": {}}
    if options.keep and path.is_file():
        import json

        record["cases"] = json.loads(path.read_text(encoding="utf-8"))["cases"]
    for folder in folders:
        if folder.name not in record["cases"]:
            case = load_case(folder, THICKNESS_MM.get(folder.name))
            without = {} if options.no_without else WITHOUT
            record["cases"][folder.name] = measure_case(case, settings, without, options.ckpt)
            write_json(path, record)
    text = layer_tables(record)
    write_text(options.output / "layers.md", text)
    print(text)
    if options.docs:
        put_between_markers(options.docs, "layers", text)
    if options.figure:
        from studies.motion.figure import draw_slice_errors

        draw_slice_errors(record["cases"], options.figure)
    return 0


def case_folders(root: Path, patterns: Sequence[str]) -> list[Path]:
    """The cases' folders, from no motion to much.

    Raises:
        InputError: none matches.
    """
    found = [f for f in sorted(root.glob("*")) if f.is_dir() and any(fnmatch(f.name, p) for p in patterns)]
    if not found:
        raise InputError(f"{root}: no case named {' or '.join(patterns)}; change --cases or G3R_TEST_DATA")

    def rank(folder: Path) -> int:
        return next((n for n, p in enumerate(ORDER) if fnmatch(folder.name, p)), len(ORDER))

    return sorted(found, key=rank)


def measure_case(
    case: SimulatedCase, settings: ReconstructionSettings, without: Mapping[str, Options], ckpt: str | None
) -> dict[str, Any]:
    """Errors after each layer, and scores with everything and with a layer left out."""
    from g3r.planning.presets import changed
    from studies.motion.figure import jerk_slices
    from studies.runs import reconstructed, registered

    header = case.header_error()
    layers: dict[str, Any] = {"headers": {**header.figures(), "per_slice_mm": _listed(header.per_slice_mm)}}
    everything: Run | None = None
    for layer in LAYERS:
        changed_settings = changed(settings, layer.options)
        if layer.full:
            run = everything = reconstructed(case, changed_settings, ckpt)
        else:
            run = registered(case, changed_settings, ckpt)
        layers[layer.name] = {**run.record(), "per_slice_mm": _listed(run.error.per_slice_mm)}
        print(_line(case.name, f"after {layer.name}", run), flush=True)
    if everything is None:
        everything = reconstructed(case, settings, ckpt)
    runs = {"everything": everything}
    for name, options in without.items():
        runs[name] = reconstructed(case, changed(settings, options), ckpt)
        print(_line(case.name, f"without {name}", runs[name]), flush=True)
    return {
        "layers": layers,
        "without": {name: run.record() for name, run in runs.items()},
        "n_slices": [stack.image.shape[2] for stack in case.stacks],
        "jerks": jerk_slices(case.true, case.points_mm),
    }


def _listed(per_slice_mm: Mapping[tuple[int, int], float]) -> list[list[float]]:
    return [[stack, k, round(error, 4)] for (stack, k), error in per_slice_mm.items()]


def _line(case: str, what: str, run: Run) -> str:
    psnr = f", {run.scores.psnr_db:.2f} dB" if run.scores else ""
    error = run.error
    return f"{case}, {what}: TRE {error.median_mm:.2f} / {error.p90_mm:.2f} mm{psnr}, {run.seconds:.0f} s"


def layer_tables(record: Mapping[str, Any]) -> str:
    """Two tables in Markdown: errors after each layer, volumes with a layer left out."""
    cases: Mapping[str, Any] = record["cases"]
    names = list(dict.fromkeys(name for case in cases.values() for name in case["layers"]))
    errors = [
        [case, *(_cell(figures["layers"].get(n), "{median_mm:.2f} / {p90_mm:.2f}") for n in names)]
        for case, figures in cases.items()
    ]
    seconds = [
        [case, *(_cell(figures["layers"].get(n), "{seconds:.0f}") for n in names[1:])]
        for case, figures in cases.items()
    ]
    variants = list(dict.fromkeys(name for case in cases.values() for name in case["without"]))
    volumes = [
        [case, *(_cell(figures["without"].get(n), "{psnr_db:.2f} ({median_mm:.2f})") for n in variants)]
        for case, figures in cases.items()
    ]
    titles = [name if name == "everything" else f"without {name}" for name in variants]
    return "\n".join(
        [
            f"Preset `{record['preset']}`, {record['threads']} threads. "
            "TRE after each layer, median / 90th percentile over slices in mm:",
            "",
            markdown_table(["case", *names], errors),
            "",
            "Wall seconds from the stacks to the end of that layer (of the last: to the volume):",
            "",
            markdown_table(["case", *names[1:]], seconds),
            "",
            "PSNR of the volume in dB (and median TRE in mm) with everything, and with one thing left out:",
            "",
            markdown_table(["case", *titles], volumes),
        ]
    )


def _cell(figures: Mapping[str, Any] | None, form: str) -> str:
    return form.format(**figures) if figures else ""


if __name__ == "__main__":
    sys.exit(main())
