"""Artefacts inside single slices, by torchio: motion during a slice's own acquisition, ghosts, k-space spikes.

torchio's `RandomMotion` fills parts of an image's k-space from moved copies of it, which blurs that image and
makes it ring. It is not the motion from slice to slice, which `data_synth.motion` makes.
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
"""Thickness of a slice as torchio sees it: motion through the plane must not carry it out of its one voxel."""


def slice_artefacts() -> tio.OneOf:
    """One of the artefacts; images are [1, I, J], with k-space lines along J for motion and along either for ghosts."""
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
        share: probability (0 to 1) that a slice has one.
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
    """A transform as a function of a stack [1, I, J, K] whose slices are taken one after another, in pixels.

    Each slice draws anew from torch's generator, as a part of a transform that is `applied`.

    Args:
        transform: see `slice_artefacts`.
    """
    pixel = np.ones(2)
    return lambda stack: torch.stack(
        [_magnitude(transform(_as_subject(one, pixel))) for one in stack[0].unbind(-1)], dim=-1
    )[None]


def _as_subject(image: Tensor, spacing_mm: NDArray[np.float64]) -> tio.Subject:
    """A slice [I, J] as torchio is to see it."""
    # the last axis counts torchio's k-space lines: it must be one of the plane
    affine = np.diag([SLICE_WIDTH_MM, spacing_mm[0], spacing_mm[1], 1.0])
    return tio.Subject(image=tio.ScalarImage(tensor=image.contiguous()[None, None], affine=affine))


def _magnitude(subject: Any) -> Tensor:
    return subject["image"].data[0, 0].abs()  # scanners write magnitudes
