"""The mask options of `g3r-infer` and `g3r-mask`, and their implementation."""

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
"""Stands for a mask's file: the mask is found automatically."""


def add_mask_options(parser: argparse._ActionsContainer) -> None:
    """Add the options for brain masks."""
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
    """Add the options for the masker, which finds masks."""
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
    """End the program with 2 if mask options cannot be combined; a single `auto` is applied to all stacks."""
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
    """End the program with 2 if options of the masker are invalid."""
    missing = [place for place in ("{stack}", "{mask}") if place not in (options.mask_command or place)]
    if missing:
        parser.error(f"--mask-command: no {' and no '.join(missing)} in {options.mask_command!r}; the tool gets both")
    if options.mask_timeout is not None:
        if not 0 < options.mask_timeout < float("inf"):
            parser.error(f"--mask-timeout {options.mask_timeout:g}; expected a positive number of seconds")
        if not options.mask_command:
            parser.error("--mask-timeout is for --mask-command, which is not given")


def check_threads(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """End the program with 2 if the number of threads is below 1."""
    if options.threads is not None and options.threads < 1:
        parser.error(f"--threads {options.threads}; expected at least 1")


def given_masks(options: argparse.Namespace) -> list[str | None]:
    """The user's mask file for each stack; None if the mask is to be found."""
    return [None if one == AUTO else one for one in options.masks or [None] * len(options.stacks)]


def needs_network(options: argparse.Namespace) -> bool:
    """Whether the mask network may be needed."""
    made_otherwise = options.whole_image or options.mask_command or options.anatomy != FETAL_BRAIN
    return None in given_masks(options) and not made_otherwise


def mask_weights_path(given: str | None, prior: str | None = None) -> Path:
    """The file of the mask network.

    Args:
        given: path of the file; None for a shipped one.
        prior: path or set of the prior's weights; a set applies to all networks.

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
    """The stacks that are used, with their masks.

    Args:
        options: has the paths of stacks and masks.
        weights: weights of the mask network; None if not needed.

    Raises:
        InputError: a stack cannot be read, the masker fails, or no stack shows a brain.
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
    """The masker, which finds masks that are not given.

    Args:
        options: options of `add_masker_options`, and `threads`.
        weights: weights of the mask network; None if not needed.
    """
    if options.mask_command:
        from g3r.masking.command import TIMEOUT_S, MaskCommand

        return MaskCommand(options.mask_command, options.mask_timeout or TIMEOUT_S).mask_of

    @functools.cache
    def network() -> AutomaticMask:  # torch takes seconds to import, and most runs have masks
        with lean():
            from g3r.mask_network.model import MaskModel
        from g3r.masking.automatic import AutomaticMask
        from g3r.run.machine import use_threads

        use_threads(options.threads)
        return AutomaticMask(MaskModel.load(weights))

    return lambda path, volume: network().mask_of(path, volume)
