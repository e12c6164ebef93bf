"""`g3r-export`: turn a training checkpoint of the prior or of the pose network into the file that is used."""

import argparse
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g3r.errors import G3RError, InputError

if TYPE_CHECKING:
    from g3r.pose_network.checkpoint import PoseCheckpoint
    from g3r.prior.checkpoint import PriorCheckpoint

EXPORT_KEYS = ("g3r_prior", "g3r_pose")
"""Where training checkpoints keep what an export needs: of the prior, of the pose network."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code (0 done, 2 usage, 3 bad input)."""
    parser = argparse.ArgumentParser(prog="g3r-export", description=__doc__)
    parser.add_argument("run", metavar="RUN.ckpt", type=Path, help="checkpoint written by g3r-pretrain")
    parser.add_argument("file", metavar="FILE.pt", type=Path, help="file to write")
    parser.add_argument("--data-description", metavar="TEXT", help="training data in words, kept in the file")
    parser.add_argument("--force", action="store_true", help="replace FILE.pt if it exists")
    arguments = parser.parse_args(argv)
    try:
        meta = export(arguments.run, arguments.file, arguments.data_description, replace=arguments.force)
    except G3RError as error:
        print(f"g3r-export: {error}", file=sys.stderr)
        return error.exit_code
    size_mb = arguments.file.stat().st_size / 1e6
    print(f"{arguments.file}: {size_mb:.1f} MB, {_in_words(meta)}")
    print(f"trained on: {meta.training_data}")
    for name, value in sorted(meta.validation.items()):
        print(f"  {name:20s} {value:.4f}")
    return 0


def export(
    run: Path, file: Path, data_description: str | None = None, *, replace: bool = False
) -> "PriorCheckpoint | PoseCheckpoint":
    """Write a prior or a pose checkpoint from a Lightning one, whichever kind that is.

    Args:
        run: checkpoint written by `PriorModule` or `PoseModule` under a Lightning trainer.
        file: file to write.
        data_description: training data in words; None keeps what the run recorded.
        replace: overwrite an existing file.

    Returns:
        The description that was written.

    Raises:
        InputError: `run` is missing, damaged or of another kind; `file` exists or cannot be written.
    """
    if file.exists() and not replace:
        raise InputError(f"{file}: exists already; pass --force to replace it, or another name")
    content = _read_run(run)
    kind = next(key for key in EXPORT_KEYS if key in content)
    write = _write_prior if kind == "g3r_prior" else _write_pose
    try:
        described = content[kind]
        recorded = f"{described['training_data']}; {described['optimiser_steps']} optimiser steps"
        words = recorded if data_description is None else data_description
        if not all(bool(value.isfinite().all()) for value in content["state_dict"].values()):
            raise InputError(f"{run}: the weights hold NaN or infinity; export an earlier checkpoint of the run")
        return write(file, described, _weights(content), words)
    except (G3RError, MemoryError):
        raise
    except Exception as error:  # a network given other numbers than it expects may raise anything
        found = " ".join(str(error).split())[:120]
        raise InputError(f"{run}: cannot be exported ({found}); export another checkpoint") from error


def _write_prior(file: Path, described: dict[str, Any], weights: dict[str, Any], words: str) -> "PriorCheckpoint":
    """Write a prior file, and see that it can be read."""
    from g3r.prior.checkpoint import PriorCheckpoint, load_prior, save_prior_checkpoint
    from g3r.prior.dgpn import DensityGatedPriorNetwork

    network = DensityGatedPriorNetwork(**described["network_arguments"])
    network.load_state_dict(weights)
    meta = PriorCheckpoint(
        network_arguments=network.arguments(),
        voxel_mm=float(described["voxel_mm"]),
        training_data=words,
        validation=described["validation"],
    )
    save_prior_checkpoint(file, network, meta)
    load_prior(file)
    return meta


def _write_pose(file: Path, described: dict[str, Any], weights: dict[str, Any], words: str) -> "PoseCheckpoint":
    """Write a pose file, and see that it can be read."""
    import numpy as np

    from g3r.acquisition.atlas_template import AtlasTemplate
    from g3r.pose_network.checkpoint import PoseCheckpoint, centred_grid, load_pose_network, save_pose_checkpoint
    from g3r.pose_network.network import PoseNetwork

    network = PoseNetwork(**described["network_arguments"])
    network.load_state_dict(weights)
    arguments = network.arguments()
    grid = centred_grid(arguments["template_shape"], arguments["template_spacing_mm"])
    heads = network.template.permute(3, 0, 1, 2).numpy()
    meta = PoseCheckpoint(
        network_arguments=arguments,
        template=AtlasTemplate(heads, grid.affine, np.asarray(described["weeks"], float)),
        training_data=words,
        validation=described["validation"],
    )
    save_pose_checkpoint(file, network, meta)
    load_pose_network(file)
    return meta


def _weights(content: dict[str, Any]) -> dict[str, Any]:
    """The network's part of a training checkpoint's state."""
    prefix = "network."
    return {
        name.removeprefix(prefix): value for name, value in content["state_dict"].items() if name.startswith(prefix)
    }


def _in_words(meta: "PriorCheckpoint | PoseCheckpoint") -> str:
    """What the file holds, in half a line."""
    from g3r.prior.checkpoint import PriorCheckpoint

    if isinstance(meta, PriorCheckpoint):
        return f"voxels of {meta.voxel_mm:g} mm, alpha {meta.alpha:g}"
    weeks = ", ".join(f"{week:g}" for week in meta.template.weeks)
    return f"poses from pixels of {meta.pixel_mm:g} mm, mean heads of {weeks} weeks"


def _read_run(run: Path) -> dict[str, Any]:
    """Return a training checkpoint's content, or say in one line why there is none."""
    import torch

    expected = "expected a training checkpoint of g3r-pretrain, such as .../checkpoints/last.ckpt"
    try:
        with warnings.catch_warnings(action="ignore"):  # the file's, which a refusal says better
            content = torch.load(run, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise InputError(f"{run}: no such file; {expected}") from error
    except Exception as error:  # torch.load says "damaged" in many types
        raise InputError(f"{run}: cannot be read as a checkpoint ({type(error).__name__}); {expected}") from error
    if isinstance(content, dict) and content.get("format") in ("g3r-prior", "g3r-pose"):
        raise InputError(f"{run}: is an exported {content['format'].removeprefix('g3r-')} already; {expected}")
    if not isinstance(content, dict) or "state_dict" not in content or not any(key in content for key in EXPORT_KEYS):
        raise InputError(f"{run}: was not written by g3r-pretrain; {expected}")
    return content


if __name__ == "__main__":
    sys.exit(main())
