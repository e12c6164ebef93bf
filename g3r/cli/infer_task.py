"""The task of `g3r-infer` from its options: inputs read and checked, settings and deadlines decided."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from g3r.cli.mask_options import given_masks, mask_weights_path, masked_stacks, needs_network
from g3r.cli.slice_options import load_slices, slice_hashes
from g3r.errors import InputError
from g3r.report.stage_words import FINDING_MASKS, LOADING, PREPARING

if TYPE_CHECKING:
    from g3r.acquisition.stacks import Stack
    from g3r.checkpoints.weights_file import WeightsFile
    from g3r.masking.find import MaskedStacks
    from g3r.output.record import Inputs, RunRecord
    from g3r.planning.memory_limit import MemoryPlan
    from g3r.planning.plan import Plan
    from g3r.planning.presets import ReconstructionSettings
    from g3r.reconstruct import GaussianReconstructor
    from g3r.reuse.slice_input import SliceFolder
    from g3r.run.provenance import FileHash
    from g3r.run.reporter import Reporter

STARTED_S = time.monotonic()
"""Start of the command; Python itself takes a few hundredths of a second before."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """The task of the command, with checked input.

    Attributes:
        stacks: stacks to reconstruct.
        settings: as requested.
        memory: settings that stay below the memory limit.
        reconstructor: reconstructor with loaded networks.
        inputs: hashes of all files.
        n_threads: number of threads in use.
        plan: settings and deadlines of the run.
        slices: slice folder that the stacks were made from; None if stacks were given.
        warnings: stacks that are left out, and differences from the run of --config.
        notes: remarks for the record.
    """

    stacks: list[Stack]
    settings: ReconstructionSettings
    memory: MemoryPlan
    reconstructor: GaussianReconstructor
    inputs: Inputs
    n_threads: int
    plan: Plan
    warnings: list[str]
    slices: SliceFolder | None = None
    notes: list[str] = field(default_factory=list)

    def told(self) -> Iterator[tuple[str, dict[str, object]]]:
        """Lines of `stage_words` about the input, and the values to fill in."""
        n_stacks, sources = len(self.stacks), [stack.mask_source for stack in self.stacks]
        n_given = sources.count("file")
        if self.slices is not None:
            by = "index.tsv" if self.slices.index_path else "their headers"
            yield "slices", {"n_slices": self.slices.n_slices, "n_stacks": n_stacks, "by": by}
            return
        n_found = n_stacks - n_given - sources.count("whole image") - sources.count("empty background")
        facts: dict[str, object] = {"n_given": n_given, "n_found": n_found, "n_stacks": n_stacks}
        if not n_given and not n_found:
            yield "whole image", {}
        elif n_given and n_found:
            yield "masks mixed", facts
        else:
            yield "masks found" if n_found else "masks given", facts
        thickness = " and ".join(f"{mm:g}" for mm in sorted({stack.thickness_mm for stack in self.stacks}))
        n_slices = sum(stack.image.shape[2] for stack in self.stacks)
        yield "stacks", {"n_stacks": n_stacks, "n_slices": n_slices, "thickness": f"{thickness} mm"}
        if n := sum(stack.origin.thickness_from == "spacing" for stack in self.stacks):
            yield "thickness unknown", {"n": n}


def earlier_run(options: argparse.Namespace) -> RunRecord | None:
    """The run of --config; its anatomy is copied to the options, because it decides how masks are found.

    Args:
        options: options of g3r-infer.

    Raises:
        InputError: the file cannot be used, or is of an interrupted run or of another number of stacks.
    """
    if not options.config:
        return None
    from g3r.output.record import RunRecord

    earlier = RunRecord.read(options.config)
    if earlier.partial:
        raise InputError(f"{options.config}: is of an interrupted run; pass the run.json of a complete result")
    if len(options.stacks) < len(earlier.stacks):
        _check_number(options, earlier, len(options.stacks))
    options.anatomy = earlier.settings.anatomy
    return earlier


def _check_number(options: argparse.Namespace, earlier: RunRecord, n_stacks: int) -> None:
    """Refuse to take the slice profiles of another number of stacks than that of the stacks with a head."""
    n_then = len(earlier.stacks)
    if n_then != n_stacks and not options.thickness and not options.slices:
        raise InputError(f"{options.config}: is of {n_then} stacks, {n_stacks} are given; pass --thickness to use it")


def check_files(options: argparse.Namespace, folder: Path, *, replaces: bool) -> dict[str, WeightsFile]:
    """Check all files that can be checked without reading an image; returns the files of networks, by kind.

    Args:
        options: options of g3r-infer.
        folder: folder for the results.
        replaces: whether earlier results in the folder may be replaced.

    Raises:
        InputError: a file is missing or cannot be used, or the folder must not be written.
    """
    from g3r.acquisition.sidecar import sidecar_path
    from g3r.checkpoints.shipped import set_of, weights_path
    from g3r.checkpoints.weights_file import read_weights
    from g3r.output.files import OUTPUT_NAMES
    from g3r.run.output_folder import check_output_folder

    sources = {"prior": options.ckpt, "pose": options.pose_ckpt or set_of(options.ckpt)}
    networks = {kind: weights_path(source, kind) for kind, source in sources.items() if source}
    if needs_network(options):
        networks["mask"] = mask_weights_path(options.mask_ckpt, options.ckpt)
    sidecars = [path for path in map(sidecar_path, options.stacks) if os.path.isfile(path)]
    masks = [mask for mask in given_masks(options) if mask is not None]
    inputs = [*options.stacks, *sidecars, *masks, *networks.values()]
    check_output_folder(folder, OUTPUT_NAMES, replace=replaces, inputs=inputs)
    if options.tensorboard:
        from g3r.output.tensorboard import check_tensorboard

        check_tensorboard(Path(options.tensorboard), folder)
    return {kind: read_weights(path, kind) for kind, path in networks.items()}


def prepared(
    options: argparse.Namespace, networks: dict[str, WeightsFile], earlier: RunRecord | None, reporter: Reporter
) -> Task:
    """Read and check everything that the run needs.

    Args:
        options: options of g3r-infer.
        networks: files of networks, by kind.
        earlier: the run of --config.
        reporter: is notified of each step.

    Raises:
        InputError: something in the files or options cannot be used.
    """
    slices, masked = None, None
    if options.slices:
        reporter.begun(LOADING)
        slices = load_slices(options, earlier)
        stacks = slices.stacks
    else:
        reporter.begun(FINDING_MASKS)
        masked = masked_stacks(options, networks.get("mask"))
        if earlier:
            _check_number(options, earlier, len(masked.kept))
        reporter.begun(LOADING)
        stacks = _load(options, masked, earlier)
    reporter.begun(PREPARING)
    from g3r.planning.memory_limit import plan_for_stacks
    from g3r.reconstruct import GaussianReconstructor
    from g3r.run.machine import use_threads

    command = earlier.command if earlier else None
    n_threads = use_threads(options.threads or (command.threads if command else None))
    settings = earlier.settings if earlier else _settings(options)
    reconstructor = GaussianReconstructor(
        networks.get("prior"), settings, pose_checkpoint=networks.get("pose"), device=options.device
    )
    of_stacks = _stack_hashes(options, masked) if masked else slice_hashes(slices) if slices else ((), ())
    inputs = _inputs(of_stacks, masked, reconstructor, networks.get("mask"))
    memory = plan_for_stacks(stacks, settings, options.max_memory, reconstructor.networks.prior_voxel_mm)
    return Task(
        stacks=stacks,
        settings=settings,
        memory=memory,
        reconstructor=reconstructor,
        inputs=inputs,
        n_threads=n_threads,
        plan=_plan(options, memory.settings, earlier),
        slices=slices,
        warnings=(masked.left_out if masked else []) + (earlier.differences(inputs) if earlier else []),
    )


def _load(options: argparse.Namespace, masked: MaskedStacks, earlier: RunRecord | None) -> list[Stack]:
    from g3r.acquisition.images import names_of
    from g3r.acquisition.stacks import load_stacks

    thickness = options.thickness
    if thickness and len(thickness) == 1:
        thickness = thickness * len(options.stacks)
    repeats = earlier is not None and len(earlier.stacks) == len(masked.kept)
    profiles = [stack.profile() for stack in earlier.stacks] if earlier and repeats else None
    paths = [options.stacks[n] for n in masked.kept]
    told = names_of(options.stacks)  # of all given stacks, so that the numbers are those of the command line
    names = [told[n] for n in masked.kept]
    return load_stacks(paths, masked.masks, [thickness[n] for n in masked.kept] if thickness else None, profiles, names)


def _settings(options: argparse.Namespace) -> ReconstructionSettings:
    from g3r.planning.presets import PRESETS, for_anatomy, keeping_poses

    preset = PRESETS[options.preset]
    if options.time_budget is not None:
        preset = PRESETS["accurate"]  # the most that a budget may use; memory is estimated for it
    registration = replace(
        preset.registration,
        standard_orientation=options.space == "standard",
        leave_out_misfits=preset.registration.leave_out_misfits and options.misfits == "leave-out",
    )
    settings = replace(
        preset,
        registration=registration,
        resolution_mm=options.resolution,
        seed=options.seed,
        use_prior=preset.use_prior and not options.no_prior,
        fill_unseen=options.unseen == "fill",
    )
    settings = for_anatomy(settings, options.anatomy)
    return keeping_poses(settings) if options.keep_poses else settings


def _stack_hashes(
    options: argparse.Namespace, masked: MaskedStacks
) -> tuple[tuple[FileHash, ...], tuple[FileHash, ...]]:
    """Hashes of stacks and of masks."""
    from g3r.acquisition.brain_mask import FoundMask
    from g3r.run.provenance import FileHash

    masks = (one.hash() if isinstance(one, FoundMask) else FileHash.of(one) for one in masked.masks)
    return tuple(FileHash.of(options.stacks[n]) for n in masked.kept), tuple(masks)


def _inputs(
    of_stacks: tuple[tuple[FileHash, ...], tuple[FileHash, ...]],
    masked: MaskedStacks | None,
    reconstructor: GaussianReconstructor,
    mask_weights: WeightsFile | None,
) -> Inputs:
    from g3r.acquisition.brain_mask import FoundMask
    from g3r.output.record import Inputs
    from g3r.run.provenance import FileHash

    prior, pose = reconstructor.networks.stored_prior, reconstructor.networks.stored_pose
    masks = masked.masks if masked else []
    asked = any(isinstance(one, FoundMask) and one.source == "automatic" for one in masks)
    return Inputs(
        stacks=of_stacks[0],
        masks=of_stacks[1],
        prior=FileHash(prior.file.path.name, prior.file.sha256) if prior else None,
        pose_network=FileHash(pose.file.path.name, pose.file.sha256) if pose else None,
        mask_network=FileHash(mask_weights.path.name, mask_weights.sha256) if mask_weights and asked else None,
    )


def _plan(options: argparse.Namespace, settings: ReconstructionSettings, earlier: RunRecord | None) -> Plan:
    """Plan of the rest of a time budget, of the repeated budget of an earlier run, or of fixed settings."""
    from g3r.planning.plan import FixedPlan, RepeatedBudget
    from g3r.planning.time_budget import TimeBudget

    if earlier and earlier.time_budget:
        if options.resume:
            raise InputError(f"{options.config}: --resume: a run with a time budget keeps no stages; leave it out")
        return RepeatedBudget(settings, earlier.time_budget)
    if options.time_budget is not None:
        return TimeBudget.of(settings, options.time_budget, time.monotonic() - STARTED_S)
    return FixedPlan(settings)
