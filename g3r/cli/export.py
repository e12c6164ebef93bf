"""`g3r-export`: turn a training checkpoint into the one file that `g3r-infer --ckpt` reads."""

import argparse
import pickle
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g3r.errors import G3RError, InputError

if TYPE_CHECKING:
    from g3r.prior.checkpoint import PriorCheckpoint


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code (0 done, 2 usage, 3 bad input)."""
    parser = argparse.ArgumentParser(prog="g3r-export", description=__doc__)
    parser.add_argument("run", metavar="RUN.ckpt", type=Path, help="checkpoint written by g3r-pretrain")
    parser.add_argument("prior", metavar="PRIOR.pt", type=Path, help="file to write")
    parser.add_argument("--data-description", metavar="TEXT", help="training data in words, kept in the file")
    parser.add_argument("--force", action="store_true", help="replace PRIOR.pt if it exists")
    arguments = parser.parse_args(argv)
    try:
        meta = export_prior(
            arguments.run, arguments.prior, arguments.data_description, replace=arguments.force
        )
    except G3RError as error:
        print(f"g3r-export: {error}", file=sys.stderr)
        return error.exit_code
    size_mb = arguments.prior.stat().st_size / 1e6
    print(f"{arguments.prior}: {size_mb:.1f} MB, voxels of {meta.voxel_mm:g} mm, alpha {meta.alpha:g}")
    print(f"trained on: {meta.training_data}")
    for name, value in sorted(meta.validation.items()):
        print(f"  {name:20s} {value:.4f}")
    return 0


def export_prior(
    run: Path, prior: Path, data_description: str | None = None, *, replace: bool = False
) -> "PriorCheckpoint":
    """Write a prior checkpoint from a Lightning one.

    Args:
        run: checkpoint written by `PriorModule` under a Lightning trainer.
        prior: file to write.
        data_description: training data in words; None keeps what the run recorded.
        replace: overwrite an existing file.

    Returns:
        The description that was written.

    Raises:
        InputError: `run` is missing, damaged or of another kind; `prior` exists or cannot be written.
    """
    if prior.exists() and not replace:
        raise InputError(f"{prior}: exists already; pass --force to replace it, or another name")
    content = _read_run(run)

    from g3r.prior.checkpoint import PriorCheckpoint, load_prior, save_prior_checkpoint
    from g3r.prior.dgpn import DensityGatedPriorNetwork

    described = content["g3r_prior"]
    try:
        network = DensityGatedPriorNetwork(**described["network_arguments"])
        prefix = "network."
        network.load_state_dict(
            {
                name.removeprefix(prefix): value
                for name, value in content["state_dict"].items()
                if name.startswith(prefix)
            }
        )
        steps = described["optimiser_steps"]
        recorded = f"{described['training_data']}; {steps} optimiser steps"
        meta = PriorCheckpoint(
            network_arguments=network.arguments(),
            voxel_mm=float(described["voxel_mm"]),
            training_data=recorded if data_description is None else data_description,
            validation=described["validation"],
        )
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        found = " ".join(str(error).split())[:120]
        raise InputError(f"{run}: cannot be exported ({found}); export another checkpoint") from error
    if not all(bool(value.isfinite().all()) for value in network.state_dict().values()):
        raise InputError(f"{run}: the weights hold NaN or infinity; export an earlier checkpoint of the run")
    save_prior_checkpoint(prior, network, meta)
    load_prior(prior)  # what was written is readable
    return meta


def _read_run(run: Path) -> dict[str, Any]:
    """Return a training checkpoint's content, or say in one line why there is none."""
    import torch

    expected = "expected a training checkpoint of g3r-pretrain, such as .../checkpoints/last.ckpt"
    try:
        content = torch.load(run, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise InputError(f"{run}: no such file; {expected}") from error
    except (OSError, pickle.UnpicklingError, RuntimeError, EOFError, ValueError, LookupError) as error:
        raise InputError(
            f"{run}: cannot be read as a checkpoint ({type(error).__name__}); {expected}"
        ) from error
    if isinstance(content, dict) and content.get("format") == "g3r-prior":
        raise InputError(f"{run}: is an exported prior already; {expected}")
    if not isinstance(content, dict) or "state_dict" not in content or "g3r_prior" not in content:
        raise InputError(f"{run}: was not written by g3r-pretrain; {expected}")
    return content


if __name__ == "__main__":
    sys.exit(main())
