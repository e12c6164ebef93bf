"""Which layers of registration run, and how long they search."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RegistrationSettings:
    """Which layers run, and how long they search.

    Args:
        flatten: divide slow trends of intensity out of each stack before it is registered.
        template: place runs of slices in mean heads (needs a template); gives the standard orientation.
        network: consider the pose network's proposal.
        network_as_reserve: ... only where no mean head is of the subject's size.
        stacks: consider stacks registered to each other from many starts.
        segments: place runs of slices again in the volume of the other stacks.
        n_candidates: random motions tried for a stack in one go of the search.
        attempts: searches with other random numbers, at most, where stacks do not predict each other.
        n_rounds: alternations of volume and slices; 0 leaves the slices where the runs are.
        steps_per_round: Gauss-Newton steps of the slices in a round.
        finest_voxel_mm: voxel of the last rounds.
        max_pixels: masked pixels in use; larger subjects are thinned on coarse levels.
        standard_orientation: turn the result into the atlas frame; otherwise it stays in scanner space.
        seed: of the random search.
    """

    bias_correction: bool = True
    template: bool = True
    network: bool = True
    network_as_reserve: bool = False
    stacks: bool = True
    segments: bool = True
    n_candidates: int = 4000
    attempts: int = 3
    n_rounds: int = 12
    steps_per_round: int = 5
    finest_voxel_mm: float = 1.2
    max_pixels: int = 400_000
    standard_orientation: bool = True
    seed: int = 0
