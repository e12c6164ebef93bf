"""`g3r-pretrain`: train the prior network, the pose network or the mask network with LightningCLI."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from g3r._version import __version__
from g3r.errors import G3RError

_HELP = """\
usage: g3r-pretrain fit --config lightning_configs/prior.yaml [--data.source DIR] [options]

Train the density-gated prior network, the pose network (lightning_configs/pose.yaml) or the mask
network (lightning_configs/mask.yaml). Logs for TensorBoard and checkpoints go to one folder.

  fit, validate            what to do
  --config FILE            settings; every one of them can be overridden on the command line
  --model CLASS            what to train, as the configs name it: g3r.training.prior_module.PriorModule,
                           g3r.training.pose_module.PoseModule or g3r.training.mask_module.MaskModule
  --model.network.NAME V   an argument of the network
  --data.source DIR        folder with atlas volumes and masks; "phantom" (default) needs no data
  --trainer.max_time T     DD:HH:MM:SS; the learning rate is annealed to fit
  --ckpt_path FILE         resume from a training checkpoint

All options: g3r-pretrain fit --help      Watch: tensorboard --logdir runs
Afterwards:  g3r-export runs/prior/version_0/checkpoints/last.ckpt prior.safetensors
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code (0 done, 2 usage, 3 bad input)."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_HELP, end="")
        return 0 if arguments else 2

    if arguments[0] == "--version":
        print(f"g3r-pretrain {__version__}")
        return 0

    from g3r.cli.failures import missing_extra

    try:
        from lightning.pytorch import LightningDataModule, Trainer
        from lightning.pytorch.cli import LightningCLI

        from g3r.training.annealed_module import AnnealedModule, WholeCheckpoints
    except ModuleNotFoundError as error:
        print(f"g3r-pretrain: {missing_extra(error)}", file=sys.stderr)
        return 3

    class PretrainCLI(LightningCLI):
        def instantiate_trainer(self, **options: Any) -> Trainer:
            return super().instantiate_trainer(plugins=[WholeCheckpoints()], **options)

    try:
        PretrainCLI(
            AnnealedModule,
            LightningDataModule,
            subclass_mode_model=True,
            subclass_mode_data=True,
            seed_everything_default=1,
            save_config_kwargs={"overwrite": True},  # a resumed run writes its settings again
            args=arguments,
        )
    except (G3RError, ValueError, SystemExit) as error:
        own = _own_error(error)  # jsonargparse wraps what the model raises in an error of its own
        if own is None:
            raise
        print(f"g3r-pretrain: {own}", file=sys.stderr)
        return own.exit_code
    return 0


def _own_error(error: BaseException | None) -> G3RError | None:
    """The first error of g3r's own among an error and those that led to it."""
    while error is not None and not isinstance(error, G3RError):
        error = error.__cause__ or error.__context__
    return error


if __name__ == "__main__":
    sys.exit(main())
