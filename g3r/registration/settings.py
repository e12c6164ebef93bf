"""Settings of registration: which layers run, and how long they search."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RegistrationSettings:
    """Which layers run, and how long they search.

    Args:
        template: initialisation by atlas templates; it also gives the standard orientation.
        network: initialisation by the pose network.
        network_as_reserve: the pose network is used only if no atlas template is of the subject's size.
        stacks: initialisation by stacks registered to each other from many starts.
        segments: place motion segments again in the volume of the other stacks.
        n_candidates: random motions tried at once for a stack in the search.
        attempts: at most this many searches for motion segments, while stacks do not predict each other well and no two
            attempts agree.
        n_rounds: alternations of volume and slices; 0 leaves the slices at their motion segments.
        stray_searches: after the rounds, at most this many searches for slices that went astray; more rounds follow
            each search that found some.
        steps_per_round: Gauss-Newton steps of the slices in a round.
        finest_voxel_mm: voxel of the last rounds.
        finest_voxel_pixels: lower bound of that voxel, in units of what a pixel covers (the cube root of its area times
            the thickness): in a volume of smaller voxels each slice fits itself, wherever it is.
        max_pixels: masked pixels in use with the finest voxel, at most; coarse levels use fewer.
        standard_orientation: move the result into the atlas frame; otherwise it stays in the scanner frame.
        check_handedness: test whether a stack is a mirror image of the others, where an atlas template fits.
        leave_out_misfits: leave out stacks that do not fit the others, if most do, and register those anew.
        seed: of the random search; in a reconstruction it is that of `ReconstructionSettings`.
    """

    template: bool = True
    network: bool = True
    network_as_reserve: bool = False
    stacks: bool = True
    segments: bool = True
    n_candidates: int = 4000
    attempts: int = 4
    n_rounds: int = 12
    stray_searches: int = 3
    steps_per_round: int = 5
    finest_voxel_mm: float = 1.2
    finest_voxel_pixels: float = 0.0
    max_pixels: int = 400_000
    standard_orientation: bool = True
    check_handedness: bool = True
    leave_out_misfits: bool = True
    seed: int = 0
