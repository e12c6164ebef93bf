"""Artefacts inside single slices, by torchio: motion during a slice's own acquisition, ghosts, k-space spikes.

torchio's `RandomMotion` fills parts of an image's k-space from moved copies of the image, which causes blur and
ringing. Motion between slices is simulated by `data_synth.motion`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
import torchio as tio
from numpy.typing import NDArray
from torch import Tensor

from data_synth.augment import applied
from data_synth.simulator import SimulatedStack

SLICE_WIDTH_MM = 1000.0
"""Slice thickness passed to torchio, so large that through-plane motion never leaves the single voxel of the slice."""


def slice_artefacts() -> tio.OneOf:
    """A transform that applies one artefact at random.

    Images are [1, I, J]. K-space lines run along J for motion, and along either axis for ghosts.
    """
    return tio.OneOf(
        {
            tio.RandomMotion(degrees=4, translation=3, num_transforms=2): 0.5,
            tio.RandomGhosting(num_ghosts=(2, 6), axes=(1, 2), intensity=(0.3, 0.8)): 0.3,
            tio.RandomSpike(num_spikes=(1, 1), intensity=(0.3, 1.2)): 0.2,
        }
    )


def with_artefacts(stacks: Sequence[SimulatedStack], share: float, rng: np.random.Generator) -> list[SimulatedStack]:
    """Stacks in which some slices have an artefact.

    Args:
        stacks: as simulated.
        share: probability (0 to 1) that a slice has an artefact.
        rng: source of randomness.
    """
    transform = slice_artefacts()
    result = []
    for one in stacks:
        image = one.stack.image.copy()
        for k in np.flatnonzero(rng.random(image.shape[2]) < share):
            subject = _as_subject(torch.from_numpy(image[:, :, k]), one.stack.spacing_mm)
            image[:, :, k] = _magnitude(applied(transform, subject, rng)).numpy()
        result.append(replace(one, stack=replace(one.stack, image=image)))
    return result


def slice_by_slice(transform: tio.Transform) -> Callable[[Tensor], Tensor]:
    """A function that applies a transform to each slice of a stack [1, I, J, K] separately, with lengths in pixels.

    Each slice draws its own random numbers from torch's generator. Use it inside a transform passed to `applied`,
    which seeds that generator.

    Args:
        transform: see `slice_artefacts`.
    """
    pixel = np.ones(2)
    return lambda stack: torch.stack(
        [_magnitude(transform(_as_subject(one, pixel))) for one in stack[0].unbind(-1)], dim=-1
    )[None]


def _as_subject(image: Tensor, spacing_mm: NDArray[np.float64]) -> tio.Subject:
    """A slice [I, J] as a torchio subject [1, 1, I, J]."""
    # torchio's k-space lines run along the last axis, which must therefore be an in-plane axis
    affine = np.diag([SLICE_WIDTH_MM, spacing_mm[0], spacing_mm[1], 1.0])
    return tio.Subject(image=tio.ScalarImage(tensor=image.contiguous()[None, None], affine=affine))


def _magnitude(subject: Any) -> Tensor:
    return subject["image"].data[0, 0].abs()  # scanners write magnitudes
