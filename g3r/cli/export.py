# PYTHON_ARGCOMPLETE_OK
"""`g3r-export`: turn a training checkpoint of the prior, the pose or the mask network into the file that is used."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from g3r._version import __version__
from g3r.cli.completion import parsed
from g3r.cli.failures import INTERRUPTED, run_command
from g3r.errors import InputError

if TYPE_CHECKING:
    from g3r.checkpoints.trained_model import TrainedModel

PROG = "g3r-export"

LESS_MEMORY = "end other programs, or use a machine with more"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code (0 done, 2 usage, 3 bad input, 4 out of memory, 130 interrupted)."""
    parser = argparse.ArgumentParser(prog=PROG, description=__doc__)
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    parser.add_argument("run", metavar="RUN.ckpt", type=Path, help="checkpoint written by g3r-pretrain")
    parser.add_argument("file", metavar="FILE.safetensors", type=Path, help="file to write")
    parser.add_argument("--data-description", metavar="TEXT", help="training data in words, kept in the file")
    parser.add_argument("--force", action="store_true", help="replace FILE.safetensors if it exists")
    arguments = parsed(parser, argv)
    return run_command(
        PROG,
        lambda: _run(arguments),
        interrupted=lambda: ("interrupted; no file was written", INTERRUPTED),
        less_memory=LESS_MEMORY,
    )


def _run(arguments: argparse.Namespace) -> int:
    model = export(arguments.run, arguments.file, arguments.data_description, replace=arguments.force)
    size_mb = arguments.file.stat().st_size / 1e6
    print(f"{arguments.file}: {size_mb:.1f} MB, {model.in_words()}")
    print(f"trained on: {model.training_data}")
    for name, value in sorted(model.validation.items()):
        print(f"  {name:20s} {value:.4f}")
    return 0


def export(run: Path, file: Path, data_description: str | None = None, *, replace: bool = False) -> TrainedModel:
    """Export the weights of a Lightning checkpoint of a prior, a pose or a mask network.

    Args:
        run: checkpoint written by `PriorModule`, `PoseModule` or `MaskModule` under a Lightning trainer.
        file: file to write; its name ends in .safetensors.
        data_description: training data in words; None keeps those that the run recorded.
        replace: overwrite an existing file.

    Returns:
        The written model, read back from the file.

    Raises:
        InputError: `run` is missing, damaged, of another kind or of other conventions, or for comparison only; `file`
            exists, has another ending or cannot be written.
    """
    from g3r.checkpoints.plain_values import shown
    from g3r.checkpoints.training_checkpoint import read_training
    from g3r.checkpoints.weights_file import SUFFIX

    if file.suffix != SUFFIX:
        raise InputError(f"{file}: expected a name that ends in {SUFFIX}; choose another name")
    if file.exists() and not replace:
        raise InputError(f"{file}: exists already; pass --force to replace it, or another name")
    checkpoint = read_training(run)
    only = checkpoint.entry.get("comparison_only")
    if only:
        raise InputError(
            f"{run}: was trained with {only}, for comparison only, since g3r-infer gives every network what it has "
            "without that option; train without it, and export that run"
        )
    types = _model_types()
    kind = checkpoint.entry.get("kind")
    if kind not in types:
        raise InputError(f"{run}: holds a network of kind {shown(kind)}; expected one of {', '.join(types)}")
    checkpoint.model(types[kind], data_description).save(file)
    return types[kind].load(file)


def _model_types() -> dict[str, type[TrainedModel]]:
    from g3r.mask_network.model import MaskModel
    from g3r.pose_network.model import PoseModel
    from g3r.prior.model import Prior

    return {Prior.kind: Prior, PoseModel.kind: PoseModel, MaskModel.kind: MaskModel}


if __name__ == "__main__":
    sys.exit(main())
