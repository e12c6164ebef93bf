"""`python -m studies.prior.networks`: variants of the prior network, trained alike and compared."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g3r.bench.record import markdown_table, put_between_markers, write_json, write_text
from g3r.errors import InputError
from studies.command import parser_of, run_command
from studies.prior.network_scores import (
    EXPORTED,
    LEFT_OUT,
    SPEED_SHAPE,
    VALIDATED_ON,
    baseline_scores,
    evaluate,
    inference_seconds,
    validation_volumes,
)

if TYPE_CHECKING:
    from torch import Tensor

CONFIG = Path(__file__).resolve().parents[2] / "lightning_configs" / "prior.yaml"


@dataclass(frozen=True)
class Variant:
    """A network to be trained.

    Args:
        name: of its folder, and in tables.
        what: how it differs, in words.
        options: of the network, beside those of the configuration.
        is_size: whether it belongs to the curve of error against seconds.
    """

    name: str
    what: str
    options: Mapping[str, Any] = field(default_factory=dict)
    is_size: bool = False


VARIANTS = (
    Variant("full", "the configuration as it is", is_size=True),
    Variant("no-gate", "G = 1 everywhere", {"use_gate": False}),
    Variant("no-density", "F does not see M_rho; gated", {"use_density": False}),
    Variant("no-density-no-gate", "neither", {"use_density": False, "use_gate": False}),
    Variant("alpha-0.05", "the paper's gate", {"alpha": 0.05}),
    Variant("no-sharp", "F does not see V_sharp: Eq. 7 as printed", {"use_sharp": False}),
    Variant("sharp-base", "the residual is added to V_sharp", {"sharp_base": True}),
    Variant("as-printed", "Eq. 7 as printed, alpha 0.05", {"use_sharp": False, "alpha": 0.05}),
    Variant("size-16-32-64", "channels 16, 32, 64", {"channels": [16, 32, 64]}, is_size=True),
    Variant("size-32-64-96", "channels 32, 64, 96", {"channels": [32, 64, 96]}, is_size=True),
    Variant("size-48-96-128", "channels 48, 96, 128", {"channels": [48, 96, 128]}, is_size=True),
)

DEFAULT_FOLDER = Path("runs") / "bench" / "prior-networks"


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = parser_of(
        "prior_networks",
        "Train variants of the prior network for the same number of steps on the same subjects and seed, and "
        "compare them on the validation volumes. Finished ones are kept, interrupted ones go on. Needs "
        "the atlas in the folder that G3R_TEST_DATA names, or --source.",
        DEFAULT_FOLDER,
    )
    parser.add_argument("--steps", type=int, default=384, metavar="N", help="of the optimiser, to whole epochs")
    parser.add_argument("--only", nargs="+", metavar="NAME", default=[], help=", ".join(names(VARIANTS)))
    parser.add_argument("--source", type=Path, help="atlas folder (None: the one of the test data)")
    parser.add_argument("--cache", type=Path, default=DEFAULT_FOLDER / "subjects", help="synthetic subjects")
    parser.add_argument("--val-subjects", type=int, default=9, metavar="N", help="volumes to compare on")
    parser.add_argument("--no-train", action="store_true", help="only the table and the figure")
    parser.add_argument("--retime", action="store_true", help="measure all seconds again, on a quiet machine")
    parser.add_argument("--figure", type=Path, metavar="PNG", help="also draw errors and seconds")
    parser.add_argument(
        "train_args", nargs="*", metavar="-- ARG", help="more arguments of g3r-pretrain, such as --data.batch_size=2"
    )
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = build_parser()
    options = parser.parse_args(argv)
    unknown = set(options.only) - set(names(VARIANTS))
    if unknown:
        parser.error(f"--only {' '.join(sorted(unknown))}; expected {', '.join(names(VARIANTS))}")
    if options.steps < 1:
        parser.error(f"--steps {options.steps}; expected at least 1")
    return run_command("prior_networks", _run, options)


def names(variants: Iterable[Variant]) -> list[str]:
    """Their names."""
    return [variant.name for variant in variants]


def _run(options: argparse.Namespace) -> int:
    import yaml

    from g3r.bench.record import available_cores, machine, use_threads
    from studies.subjects import test_data_folder

    config = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))
    threads = options.threads or available_cores()
    path = options.output / "networks.json"
    record: dict[str, Any] = {"threads": threads, "machine": machine(), "baselines": {}, "variants": {}}
    if path.is_file():
        record |= json.loads(path.read_text(encoding="utf-8"))
    use_threads(threads)
    if not options.no_train:
        source = options.source or test_data_folder() / "atlas"
        data = data_arguments(source, options.cache, options.val_subjects)
        record["arguments"] = options.train_args
        n_epochs = epochs_of(options.steps, config, options.train_args)
        volumes: list[dict[str, Tensor]] = []
        for variant in distinct_variants(config):
            if options.only and variant.name not in options.only:
                continue
            kept = record["variants"].get(variant.name, {})
            if kept.get("epochs") == n_epochs and kept.get("options") == dict(variant.options):
                print(f"{variant.name}: kept")
                continue
            run = options.output / variant.name
            checkpoint, seconds = train(variant, run, n_epochs, [*data, *options.train_args])
            if checkpoint is None:
                print(f"{variant.name}: training failed; see {run / 'train.log'}", file=sys.stderr)
                continue
            volumes = volumes or validation_volumes(source, options.cache, options.val_subjects, config)
            record["baselines"] = record["baselines"] or baseline_scores(volumes)
            record["variants"][variant.name] = {
                "what": variant.what,
                "options": dict(variant.options),
                "is_size": variant.is_size,
                "epochs": n_epochs,
                "train_seconds": round(seconds),
                **evaluate(checkpoint, run, volumes),
            }
            write_json(path, record)
    if not record["variants"]:
        raise InputError(f"{path}: holds no trained variant; leave out --no-train")
    if options.retime:
        record |= {"threads": threads, "machine": machine()}
        for name, one in record["variants"].items():
            one["seconds"] = inference_seconds(options.output / name / EXPORTED)
        write_json(path, record)
    text = network_tables(record)
    write_text(options.output / "networks.md", text)
    print(text)
    if options.docs:
        put_between_markers(options.docs, "networks", text)
    if options.figure:
        from studies.prior.figures import draw_networks

        draw_networks(record, options.figure)
    return 0


def distinct_variants(config: Mapping[str, Any]) -> list[Variant]:
    """The variants, without a size that is the configuration's own."""
    model = {
        "use_gate": True,
        "use_density": True,
        "use_sharp": True,
        "sharp_base": False,
        **config["model"]["init_args"]["network"],
    }
    return [
        variant
        for variant in VARIANTS
        if not variant.options or any(model.get(name) != value for name, value in variant.options.items())
    ]


def epochs_of(steps: int, config: Mapping[str, Any], arguments: Sequence[str] = ()) -> int:
    """Whole epochs nearest to a number of optimiser steps, at least one.

    Args:
        steps: of the optimiser.
        config: of the training.
        arguments: that may change the size of an epoch, such as `--data.batch_size=2`.
    """
    data = dict(config["data"]["init_args"])
    for argument in arguments:
        name, _, value = argument.removeprefix("--data.").partition("=")
        if name in data and value.isdecimal():
            data[name] = int(value)
    per_epoch = data["subjects_per_epoch"] * data["patches_per_subject"] // data["batch_size"]
    return max(1, round(steps / per_epoch))


def data_arguments(source: Path, cache: Path, val_subjects: int) -> list[str]:
    """What all variants are told about their data."""
    listed = {"exclude": LEFT_OUT, "val_include": VALIDATED_ON}
    return [
        f"--data.source={source}",
        f"--data.cache={cache}",
        f"--data.val_subjects={val_subjects}",
        *(f"--data.{name}={json.dumps(patterns)}" for name, patterns in listed.items()),
    ]


def train(variant: Variant, run: Path, n_epochs: int, arguments: Sequence[str]) -> tuple[Path | None, float]:
    """Train a variant in a process of its own, going on where an earlier one stopped.

    Returns:
        Its last checkpoint, or None where the training failed (`train.log` says why), and wall seconds.
    """
    run.mkdir(parents=True, exist_ok=True)
    last = newest_checkpoint(run)
    command = [
        sys.executable,
        "-m",
        "g3r.cli.pretrain",
        "fit",
        "--config",
        str(CONFIG),
        *arguments,
        *(f"--model.network.{name}={json.dumps(value)}" for name, value in variant.options.items()),
        f"--trainer.max_epochs={n_epochs}",
        "--trainer.max_time=null",
        "--trainer.enable_progress_bar=false",
        f"--trainer.logger.init_args.save_dir={run}",
        "--trainer.logger.init_args.name=logs",
        *([f"--ckpt_path={last}"] if last else []),
    ]
    print(f"{variant.name}: {'going on' if last else 'training'}, {n_epochs} epochs", flush=True)
    start = time.perf_counter()
    with (run / "train.log").open("ab") as log:
        done = subprocess.run(command, cwd=CONFIG.parents[2], stdout=log, stderr=log, check=False)
    seconds = time.perf_counter() - start
    return (newest_checkpoint(run) if done.returncode == 0 else None), seconds


def newest_checkpoint(run: Path) -> Path | None:
    """The last checkpoint of the last process that trained in a folder."""
    found = sorted(run.glob("logs/version_*/checkpoints/last*.ckpt"), key=lambda path: path.stat().st_mtime)
    return found[-1] if found else None


def network_tables(record: Mapping[str, Any]) -> str:
    """A row per variant in Markdown, those it starts from first."""
    variants: Mapping[str, Any] = record["variants"]
    ordered = [name for name in names(VARIANTS) if name in variants]
    numbers = sorted(n for n in variants[ordered[0]]["scores"] if n != "all")
    head = ["", "differs by", "L1", *(f"{n} stack{'s' * (n != '1')}, dB" for n in numbers), "all, dB", "SSIM"]
    head += ["weights", "s per brain", "steps", "trained, min"]
    rows = [[name, "", *_score_cells(scores, numbers), "", "", "", ""] for name, scores in record["baselines"].items()]
    for name in ordered:
        one = variants[name]
        rows.append(
            [
                name,
                one["what"],
                *_score_cells(one["scores"], numbers),
                f"{one['parameters'] / 1e6:.2f} M",
                f"{one['seconds']:.1f}",
                one["steps"],
                f"{one['train_seconds'] / 60:.0f}",
            ]
        )
    size = " x ".join(map(str, SPEED_SHAPE))
    return "\n".join(
        [
            "Mean over the validation volumes, in the mask, in normalised intensities (PSNR: range 1); "
            f"seconds for one view of {size} voxels on {record['threads']} threads. Trained with "
            f"`{' '.join(record.get('arguments', [])) or 'the configuration as it is'}`.",
            "",
            markdown_table(head, rows),
        ]
    )


def _score_cells(scores: Mapping[str, Any], numbers: Sequence[str]) -> list[str]:
    every = scores["all"]
    of_number = [f"{scores[n]['psnr_db']:.2f}" if n in scores else "" for n in numbers]
    return [f"{every['l1']:.4f}", *of_number, f"{every['psnr_db']:.2f}", f"{every['ssim']:.3f}"]


if __name__ == "__main__":
    sys.exit(main())
