"""A small phantom case of the size that other methods were timed on: `python -m studies.tradeoff.peer_phantom`.

It is the built-in phantom, shrunk to fit: a truth of 64^3 voxels of 0.8 mm and three stacks of 58 x 58 x 18 pixels of
0.8 x 0.8 x 2.4 mm, in which every slice has its own pose.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_synth.atlas import TruthVolume
from data_synth.export import check_output, save_simulation
from data_synth.phantom import fetal_brain_phantom
from data_synth.simulator import SimulatedStack, orthogonal_settings, simulate_stacks
from g3r.errors import G3RError
from studies.harness import FOLDER
from studies.subjects import BRIGHT

WEEKS = 18.0
"""The youngest age of the phantom, since heads of this size are as young and as smooth."""

VOXELS, VOXEL_MM = 64, 0.8
STACK_SHAPE, PIXEL_MM, THICKNESS_MM = (58, 58, 18), 0.8, 2.4
LENGTH_MM = 42.0
"""Longest axis of the head, which fits into the stacks with two pixels to spare."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.tradeoff.peer_phantom",
        description=__doc__.splitlines()[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--output", type=Path, default=FOLDER / "peer-phantom")
    parser.add_argument("--seed", type=int, default=61000)
    parser.add_argument("--force", action="store_true", help="replace an earlier case in --output")
    options = parser.parse_args(argv)
    try:
        _write_case(options.output, options.seed, replace_it=options.force)
    except G3RError as error:
        print(f"peer_phantom: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def _write_case(folder: Path, seed: int, *, replace_it: bool) -> None:
    """Simulate the subject and write it."""
    check_output(folder, replace=replace_it)
    truth = small_head(seed)
    settings = orthogonal_settings(3, "moderate", resolution_mm=PIXEL_MM, thickness_mm=THICKNESS_MM)
    rng = np.random.default_rng(seed)
    taken = simulate_stacks(truth.data, truth.mask, truth.affine, settings, rng, fine=True)
    stacks = [in_shape(one) for one in taken]
    record = {"phantom": WEEKS, "seed": seed, "thickness_mm": THICKNESS_MM, "length_mm": LENGTH_MM}
    save_simulation(folder, truth, stacks, record, replace=replace_it)
    shapes = ", ".join("x".join(map(str, one.stack.image.shape)) for one in stacks)
    print(f"{folder}: truth {'x'.join(map(str, truth.data.shape))}, stacks {shapes}")


def small_head(seed: int) -> TruthVolume:
    """The phantom scaled to a longest axis of `LENGTH_MM`, on a cube of voxels."""
    wide = fetal_brain_phantom(WEEKS, VOXEL_MM, seed)
    extent_mm = (np.ptp(np.argwhere(wide.mask), axis=0) + 1).max() * VOXEL_MM
    # made with larger voxels, whose size is then stated as VOXEL_MM: this shrinks the head without resampling
    made = fetal_brain_phantom(WEEKS, VOXEL_MM * extent_mm / LENGTH_MM, seed)
    low = [(n - VOXELS) // 2 for n in made.mask.shape]
    bright = np.float32(BRIGHT / np.percentile(made.t2[made.mask], 99.5))
    affine = np.diag([VOXEL_MM, VOXEL_MM, VOXEL_MM, 1.0])
    affine[:3, 3] = -VOXEL_MM * (VOXELS - 1) / 2
    shape = (VOXELS, VOXELS, VOXELS)
    return TruthVolume(
        name="phantom", data=_window(made.t2 * bright, low, shape), mask=_window(made.mask, low, shape), affine=affine
    )


def in_shape(one: SimulatedStack) -> SimulatedStack:
    """A stack cropped or zero-padded about its centre to `STACK_SHAPE`; slices are only cropped, never added."""
    stack = one.stack
    low = [(n - wanted) // 2 for n, wanted in zip(stack.image.shape, STACK_SHAPE, strict=True)]
    first, last = max(0, low[2]), min(stack.image.shape[2], low[2] + STACK_SHAPE[2])
    affine = stack.affine.copy()
    affine[:3, 3] = stack.grid.world(np.array([low[0], low[1], first]))
    shape = (*STACK_SHAPE[:2], last - first)
    low[2] = first
    cut = replace(stack, image=_window(stack.image, low, shape), mask=_window(stack.mask, low, shape), affine=affine)
    kept = slice(first, last)
    return SimulatedStack(cut, one.true_pose.take(kept), one.gain[kept], one.dropout[kept])


def _window(data: NDArray, low: Sequence[int], shape: Sequence[int]) -> NDArray:
    """The box [low, low + shape) of an array, zero where it reaches beyond.

    Args:
        data: [I, J, K].
        low: first index of the box, which may be negative.
        shape: of the box.
    """
    out = np.zeros(shape, data.dtype)
    inner = [slice(max(0, a), min(n, a + m)) for a, n, m in zip(low, data.shape, shape, strict=True)]
    there = tuple(slice(s.start - a, s.stop - a) for s, a in zip(inner, low, strict=True))
    out[there] = data[tuple(inner)]
    return out


if __name__ == "__main__":
    sys.exit(main())
