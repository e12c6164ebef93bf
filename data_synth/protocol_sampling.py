"""What a training subject's stacks are like, and what the way to the prior leaves wrong with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt, gaussian_filter
from scipy.spatial.transform import Rotation

from data_synth.atlas import TruthVolume
from data_synth.motion import LEVELS, ResidualKind, about
from data_synth.simulator import Orientation, SimulatedStack, StackSettings
from g3r.geometry import RigidPose

N_STACKS_SHARE = {1: 0.3, 2: 0.17, 3: 0.32, 4: 0.09, 5: 0.06, 6: 0.06}
DROPOUT_SHARE_IF_GROSS, SPIKE_SHARE_IF_GROSS = 0.03, 0.02

SKULL_RIM_SHARE = 0.3
"""How often skull and mother are seen around the head, and masks reach into them."""
RIM_MM = 3.0
SKULL_MM = 1.5
SMALL_MASK_SHARE = 0.1
"""How often masks miss the head's outermost voxels."""


def draw_settings(residual: ResidualKind, rng: np.random.Generator, n_stacks: int | None = None) -> list[StackSettings]:
    """Settings of one to six stacks as a protocol may have them: one resolution, mostly orthogonal.

    Args:
        residual: voids and spikes come with gross pose errors.
        rng: source of randomness.
        n_stacks: drawn when None.
    """
    drawn = int(rng.choice(list(N_STACKS_SHARE), p=list(N_STACKS_SHARE.values())))
    number = drawn if n_stacks is None else n_stacks
    level = LEVELS[str(rng.choice(["none", "mild", "moderate"]))]
    if residual == "gross":
        level = replace(level, dropout_share=DROPOUT_SHARE_IF_GROSS)
    thickness = float(rng.uniform(2.0, 5.0) if rng.random() < 0.4 else rng.uniform(2.0, 3.5))
    orthogonal: list[Orientation] = ["axial", "coronal", "sagittal"]
    first = int(rng.integers(3))
    common = StackSettings(
        resolution_mm=float(rng.uniform(0.5, 1.3)),
        thickness_mm=thickness,
        gap_mm=_draw_gap_mm(thickness, rng),
        motion=level,
        interleave=int(rng.integers(1, 4)),
        oblique_deg=float(rng.choice([0.0, 5.0, 15.0])),
        profile="box" if rng.random() < 0.7 else "gaussian",
        snr=float(np.exp(rng.uniform(np.log(12), np.log(60)))),
        bias=float(rng.uniform(0, 0.1)),
        gain_deviation=float(rng.uniform(0, 0.06)),
        spike_share=SPIKE_SHARE_IF_GROSS if residual == "gross" else 0.0,
    )
    return [
        replace(common, orientation="random" if rng.random() < 0.15 else orthogonal[(first + n) % 3])
        for n in range(number)
    ]


def _draw_gap_mm(thickness_mm: float, rng: np.random.Generator) -> float:
    """Slices mostly touch; otherwise there are gaps, or slices overlap by up to a half."""
    kind = rng.random()
    if kind < 0.55:
        return 0.0
    return float(rng.uniform(0.0, 1.5)) if kind < 0.85 else -float(rng.uniform(0.1, 0.5)) * thickness_mm


def with_skull_rim(truth: TruthVolume, rng: np.random.Generator) -> TruthVolume:
    """The head with a dark skull and a blotchy mother around it, outside the mask."""
    voxel_mm = float(np.linalg.norm(truth.affine[:3, :3], axis=0).mean())
    away_mm = distance_transform_edt(~truth.mask) * voxel_mm
    blotches = gaussian_filter(rng.standard_normal(truth.data.shape, dtype=np.float32), 4.0 / voxel_mm)
    blotches *= 0.25 / max(float(blotches.std()), 1e-6)
    rim = np.clip(rng.uniform(0.2, 0.9) + blotches, 0, None)
    rim = np.where(away_mm < rng.uniform(0.5, 2.0) * SKULL_MM, rng.uniform(0.05, 0.3), rim)
    return replace(truth, data=np.where(truth.mask, truth.data, rim).astype(np.float32))


def with_mask_errors(stacks: Sequence[SimulatedStack], rng: np.random.Generator, grow: bool) -> list[SimulatedStack]:
    """Stacks whose masks reach into the rim by up to 3 mm (`grow`), or miss the head's outermost pixels."""
    result = []
    for one in stacks:
        spacing_mm = float(np.linalg.norm(one.stack.affine[:3, 0]))
        steps = max(1, round(rng.uniform(0.2, 1.0) * (RIM_MM if grow else 1.5) / spacing_mm))
        in_plane = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], bool)[:, :, None]
        change = binary_dilation if grow else binary_erosion
        mask = change(one.stack.mask, in_plane, iterations=steps)
        if mask.any():
            one = replace(one, stack=replace(one.stack, mask=mask))
        result.append(one)
    return result


def rigid_stack(true_pose: RigidPose, center_mm: NDArray[np.float64]) -> RigidPose:
    """The one motion [K] that a stack's slices have on average: what is known of a single stack.

    Args:
        true_pose: [K] motions.
        center_mm: [3] the head's centre, about which the motions are averaged.
    """
    n = len(true_pose)
    rotation = Rotation.from_matrix(true_pose.rotation).mean()
    shift = (true_pose.apply(np.tile(center_mm, (n, 1, 1)))[:, 0] - center_mm).mean(0)
    one = about(RigidPose.from_rotvec(rotation.as_rotvec()[None], shift[None]), center_mm)
    return one.take(np.zeros(n, np.int64))
