"""`g3r-pretrain`: train the prior network, the pose network or the mask network with LightningCLI."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from g3r._version import __version__
from g3r.cli.failures import EXPECTED, INTERRUPTED, fail, line_and_code, missing_extra
from g3r.errors import G3RError, InputError, is_out_of_memory

PROG = "g3r-pretrain"

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
  --ckpt_path FILE         resume from a training checkpoint; give the other options again

All options: g3r-pretrain fit --help      Watch: tensorboard --logdir runs
Afterwards:  g3r-export runs/prior/version_0/checkpoints/last.ckpt prior.safetensors
"""

CUT_SHORT = "interrupted; --ckpt_path FILE goes on from a checkpoint of the run"
LESS_MEMORY = "lower data.batch_size, or data.patch_size of the prior network"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code (0 done, 2 usage, 3 bad input, 4 out of memory, 130 interrupted)."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_HELP, end="")
        return 0 if arguments else 2

    if arguments[0] == "--version":
        print(f"{PROG} {__version__}")
        return 0

    try:
        from lightning.pytorch import LightningDataModule, Trainer
        from lightning.pytorch.cli import LightningCLI

        from g3r.training.annealed_module import AnnealedModule
        from g3r.training.whole_checkpoints import WholeCheckpoints
    except KeyboardInterrupt:
        return fail(PROG, CUT_SHORT, INTERRUPTED)
    except ModuleNotFoundError as error:
        return fail(PROG, missing_extra(error), InputError.exit_code)

    class PretrainCLI(LightningCLI):
        def instantiate_trainer(self, **options: Any) -> Trainer:
            return super().instantiate_trainer(plugins=[WholeCheckpoints()], **options)

        def _parse_ckpt_path(self) -> None:
            """Leave the settings as they are given: Lightning would lay a checkpoint's over all of the model's."""

        def after_instantiate_classes(self) -> None:
            """Take the initial weights before the data are made, so that a wrong file is refused at once."""
            if not self.config[self.subcommand].get("ckpt_path"):
                self.model.take_initial_weights()

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
    except (KeyboardInterrupt, ValueError, SystemExit, *EXPECTED) as error:
        # jsonargparse wraps errors of the model in its own, and Lightning ends an interrupted fit by SystemExit
        found = error if isinstance(error, OSError) else _first_known(error)
        if found is None:
            raise
        if isinstance(found, KeyboardInterrupt):
            return fail(PROG, CUT_SHORT, INTERRUPTED)
        return fail(PROG, *line_and_code(found, LESS_MEMORY))
    return 0


def _first_known(error: BaseException | None) -> BaseException | None:
    """The first error in the chain of causes that the user can act on; None if there is none."""
    while error is not None and not isinstance(error, (KeyboardInterrupt, G3RError)) and not is_out_of_memory(error):
        error = error.__cause__ or error.__context__
    return error


if __name__ == "__main__":
    sys.exit(main())
