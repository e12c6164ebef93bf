"""The stages of a reconstruction: one name for the clock, the store, the memory estimate and the time budget."""

from __future__ import annotations

from enum import StrEnum

import numpy as np


class Stage(StrEnum):
    """Stages of a run, in order; the values are shown to users and written to run.json."""

    LOADING = "loading"
    REGISTRATION = "registration"
    MASKS = "masks"
    COARSE = "coarse volume"
    PRIOR = "prior"
    SLICES_TO_PRIOR = "slices to prior"
    POSE_ROUNDS = "poses in rounds"
    FIT_TO_PRIOR = "fit to prior"
    HELD_OUT = "held-out slices"
    FIT_TO_SLICES = "fit to slices"
    VOLUME = "volume"
    PRIOR_SHARE = "prior share"
    UNCERTAINTY = "uncertainty"
    WRITING = "writing"


_SPAWN_KEY = {
    Stage.FIT_TO_PRIOR: 2,
    Stage.FIT_TO_SLICES: 3,
    Stage.PRIOR_SHARE: 4,
    Stage.HELD_OUT: 5,
    Stage.POSE_ROUNDS: 6,
    Stage.VOLUME: 7,
}


def stage_rng(seed: int, stage: Stage) -> np.random.Generator:
    """The random numbers of one stage: the same whether or not the stages before it ran in this process.

    Args:
        seed: of the run.
        stage: one of those that draw numbers.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_SPAWN_KEY[stage],)))
