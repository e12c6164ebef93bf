"""Random acquisition settings of a training subject's stacks, distributed as in clinical protocols."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data_synth.motion import LEVELS
from data_synth.registration_errors import ResidualKind
from data_synth.simulator import Orientation, StackSettings

N_STACKS_SHARE = {1: 0.35, 2: 0.2, 3: 0.3, 4: 0.07, 5: 0.04, 6: 0.04}
DROPOUT_SHARE_IF_GROSS = 0.03


def draw_settings(residual: ResidualKind, rng: np.random.Generator, n_stacks: int | None = None) -> list[StackSettings]:
    """Settings of one to six stacks as in one protocol: common resolution, mostly orthogonal orientations.

    Args:
        residual: kind of pose errors; dropouts occur only with `gross` ones.
        rng: source of randomness.
        n_stacks: number of stacks; None draws it.
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
    )
    return [
        replace(common, orientation="random" if rng.random() < 0.15 else orthogonal[(first + n) % 3])
        for n in range(number)
    ]


def _draw_gap_mm(thickness_mm: float, rng: np.random.Generator) -> float:
    """Draw the gap: mostly zero, otherwise positive up to the thickness, or an overlap of up to half the thickness."""
    kind = rng.random()
    if kind < 0.5:
        return 0.0
    if kind < 0.74:
        return float(rng.uniform(0.0, 1.5))
    return float(rng.uniform(0.5, 1.0) if kind < 0.88 else -rng.uniform(0.1, 0.5)) * thickness_mm
