"""The options of `g3r-infer` and `g3r-mask` that say what is brain, and what they mean."""

from __future__ import annotations

import argparse
import functools
from pathlib import Path
from typing import TYPE_CHECKING

from g3r.errors import InputError
from g3r.planning.anatomy import FETAL_BRAIN
from g3r.run.lean_import import lean

if TYPE_CHECKING:
    from g3r.checkpoints.weights_file import WeightsFile
    from g3r.masking.automatic import AutomaticMask
    from g3r.masking.find import MaskedStacks, Masker

AUTO = "auto"
"""In place of a mask's file: it is to be found."""


def add_mask_options(parser: argparse._ActionsContainer) -> None:
    """The options that say what is brain."""
    parser.add_argument(
        "--masks",
        nargs="+",
        metavar="NIFTI",
        help="brain masks, one per stack, same order; auto in place of a file, or of all files, finds it (the default)",
    )
    add_masker_options(parser)
    parser.add_argument(
        "--whole-image", action="store_true", help="every positive voxel is brain: the stacks show nothing else"
    )


def add_masker_options(parser: argparse._ActionsContainer) -> None:
    """The options that say who finds masks."""
    parser.add_argument(
        "--mask-command",
        metavar="'CMD {stack} {mask}'",
        help="a tool that makes the masks that are not given: run once for each stack, to write {mask}",
    )
    parser.add_argument(
        "--mask-timeout", type=float, metavar="SECONDS", help="for --mask-command and one stack (default: 900)"
    )
    parser.add_argument(
        "--mask-ckpt", metavar="MASK.safetensors", help="mask network from g3r-export (default: shipped)"
    )


def check_mask_options(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """End the program with 2 where options on masks cannot go together; `auto` alone is for all stacks."""
    n_stacks = len(options.stacks)
    if options.masks == [AUTO]:
        options.masks = [AUTO] * n_stacks
    if options.masks is not None and len(options.masks) != n_stacks:
        parser.error(
            f"{len(options.masks)} masks for {n_stacks} stacks; give one per stack, in the same order, and auto where "
            "one is to be found"
        )
    if options.whole_image and (options.masks or options.mask_command):
        parser.error("--whole-image excludes --masks and --mask-command: it says that no mask is needed")
    check_masker_options(parser, options)


def check_masker_options(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """End the program with 2 where options on a masker make no sense."""
    missing = [place for place in ("{stack}", "{mask}") if place not in (options.mask_command or place)]
    if missing:
        parser.error(f"--mask-command: no {' and no '.join(missing)} in {options.mask_command!r}; the tool gets both")
    if options.mask_timeout is not None:
        if not 0 < options.mask_timeout < float("inf"):
            parser.error(f"--mask-timeout {options.mask_timeout:g}; expected a positive number of seconds")
        if not options.mask_command:
            parser.error("--mask-timeout is for --mask-command, which is not given")


def check_threads(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """End the program with 2 where there is no such number of threads."""
    if options.threads is not None and options.threads < 1:
        parser.error(f"--threads {options.threads}; expected at least 1")


def given_masks(options: argparse.Namespace) -> list[str | None]:
    """The user's file for each stack; None where the mask is to be found."""
    return [None if one == AUTO else one for one in options.masks or [None] * len(options.stacks)]


def needs_network(options: argparse.Namespace) -> bool:
    """Whether the mask network may be asked."""
    made_otherwise = options.whole_image or options.mask_command or options.anatomy != FETAL_BRAIN
    return None in given_masks(options) and not made_otherwise


def mask_weights_path(given: str | None, prior: str | None = None) -> Path:
    """The file of the mask network.

    Args:
        given: path of it.
        prior: path or set of the prior's weights, whose set is meant for all networks.

    Raises:
        InputError: the set holds no mask network.
    """
    from g3r.checkpoints.shipped import set_of, weights_path

    name = None if given else set_of(prior)
    path = weights_path(given or name, "mask")
    if name and not path.is_file():
        raise InputError(
            f"--ckpt {name}: this set of weights has no mask network; pass --masks, --mask-command, or --mask-ckpt "
            "with a network whose terms suit you"
        )
    return path


def masked_stacks(options: argparse.Namespace, weights: WeightsFile | None) -> MaskedStacks:
    """Which stacks are used, and with which masks.

    Args:
        options: with the paths of stacks and masks.
        weights: of the mask network; None where it is not needed.

    Raises:
        InputError: a stack that cannot be read, a masker that fails, or no stack with a brain in it.
    """
    from g3r.masking.find import find_masks

    if options.whole_image:
        from g3r.acquisition.brain_mask import whole_image

        return find_masks(options.stacks, None, lambda path, volume: whole_image(volume))
    if options.anatomy != FETAL_BRAIN and not options.mask_command:
        from g3r.acquisition.brain_mask import required_mask

        return find_masks(options.stacks, given_masks(options), lambda path, volume: required_mask(volume))
    return find_masks(options.stacks, given_masks(options), masker_of(options, weights))


def masker_of(options: argparse.Namespace, weights: WeightsFile | None) -> Masker:
    """What finds the masks that are not given.

    Args:
        options: of `add_masker_options`, and `threads`.
        weights: of the mask network; None where it is not asked.
    """
    if options.mask_command:
        from g3r.masking.command import TIMEOUT_S, MaskCommand

        return MaskCommand(options.mask_command, options.mask_timeout or TIMEOUT_S).mask_of

    @functools.cache
    def network() -> AutomaticMask:  # torch takes seconds, and most runs have masks
        with lean():
            from g3r.mask_network.model import MaskModel
        from g3r.masking.automatic import AutomaticMask
        from g3r.run.machine import use_threads

        use_threads(options.threads)
        return AutomaticMask(MaskModel.load(weights))

    return lambda path, volume: network().mask_of(path, volume)
