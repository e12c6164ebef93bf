# PYTHON_ARGCOMPLETE_OK
"""`g3r-export`: turn a training checkpoint of the prior, the pose or the mask network into the file that is used."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g3r._version import __version__
from g3r.cli.completion import parsed
from g3r.cli.failures import INTERRUPTED, is_out_of_memory, run_command
from g3r.errors import G3RError, InputError, one_line

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
        InputError: `run` is missing, damaged or of another kind; `file` exists, has another ending or cannot be
            written.
    """
    from g3r.checkpoints.trained_model import TRAINING_ENTRY
    from g3r.checkpoints.weights_file import SUFFIX

    if file.suffix != SUFFIX:
        raise InputError(f"{file}: expected a name that ends in {SUFFIX}; choose another name")
    if file.exists() and not replace:
        raise InputError(f"{file}: exists already; pass --force to replace it, or another name")
    content = _read_run(run, TRAINING_ENTRY)
    try:
        entry = content[TRAINING_ENTRY]
        recorded = f"{entry['training_data']}; {entry['optimiser_steps']} optimiser steps"
        words = recorded if data_description is None else data_description
        if not all(bool(value.isfinite().all()) for value in content["state_dict"].values()):
            raise InputError(f"{run}: the weights hold NaN or infinity; export an earlier checkpoint of the run")
        kind = _model_types()[entry["kind"]]
        kind.from_training(entry, _weights(content), words).save(file)
        return kind.load(file)
    except G3RError:
        raise
    except Exception as error:  # a network with unexpected values may raise anything
        if is_out_of_memory(error):
            raise
        raise InputError(f"{run}: cannot be exported ({one_line(error)}); export another checkpoint") from error


def _model_types() -> dict[str, type[TrainedModel]]:
    from g3r.mask_network.model import MaskModel
    from g3r.pose_network.model import PoseModel
    from g3r.prior.model import Prior

    return {Prior.kind: Prior, PoseModel.kind: PoseModel, MaskModel.kind: MaskModel}


def _weights(content: dict[str, Any]) -> dict[str, Any]:
    """The network's part of a training checkpoint's state."""
    prefix = "network."
    return {
        name.removeprefix(prefix): value for name, value in content["state_dict"].items() if name.startswith(prefix)
    }


def _read_run(run: Path, entry: str) -> dict[str, Any]:
    """Return the content of a training checkpoint, or raise `InputError` with the reason in one line."""
    import torch

    expected = "expected a training checkpoint of g3r-pretrain, such as .../checkpoints/last.ckpt"
    try:
        with warnings.catch_warnings(action="ignore"):  # the error message replaces torch's warnings
            content = torch.load(run, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise InputError(f"{run}: no such file; {expected}") from error
    except Exception as error:  # torch.load raises many types for a damaged file
        if is_out_of_memory(error):
            raise
        raise InputError(f"{run}: cannot be read as a checkpoint ({type(error).__name__}); {expected}") from error
    if not isinstance(content, dict) or "state_dict" not in content or entry not in content:
        raise InputError(f"{run}: was not written by this version of g3r-pretrain; {expected}")
    return content


if __name__ == "__main__":
    sys.exit(main())
