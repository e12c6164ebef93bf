"""Subjects of the paper's protocol: heads of 21 to 38 weeks, three orthogonal stacks of 0.8 x 0.8 x 2.2 mm.

The slices have the profile of a short sinc pulse. Of all profiles of the simulator it differs most from the Gaussian of
the model, and no setting was chosen on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_synth.atlas import TruthVolume, find_subjects
from data_synth.heads import PhantomSubject, load_volume_of, weeks_of
from data_synth.simulator import StackSettings
from g3r.errors import InputError
from g3r.evaluation.case import SimulatedCase
from studies.subjects import SubjectSpec, read_case, simulated_subject

FIRST_SEED, TUNING_SEED = 73_000, 72_000
"""First seeds of the subjects of the tables, and of the subjects that the baselines were tuned on."""

N_SUBJECTS = 16

WEEKS = (21.0, 38.0)

VOXEL_MM = 0.8


@dataclass(frozen=True, kw_only=True)
class PaperSubject(SubjectSpec):
    """A subject of the tables.

    Args:
        weeks: gestational age.
    """

    weeks: float

    def acquisition(self, n_stacks: int) -> list[StackSettings]:
        """Stacks as in the paper, with a profile that differs from the model's."""
        return [replace(one, profile="sinc") for one in super().acquisition(n_stacks)]


@dataclass(frozen=True, kw_only=True)
class PhantomHead(PaperSubject):
    """A phantom subject, with an individual shape and folds."""

    def truth(self, atlas: Path | None) -> TruthVolume:
        """The phantom of its age and seed."""
        return load_volume_of(PhantomSubject(self.volume, self.weeks, self.seed), VOXEL_MM)


def phantom_heads(n: int, motion: str, first_seed: int = FIRST_SEED) -> list[PaperSubject]:
    """Phantoms with ages spread evenly over 21 to 38 weeks, in an order in which the first few are spread too.

    Args:
        n: number of phantoms.
        motion: level of motion.
        first_seed: seed of the first; each has its own.
    """
    low, high = WEEKS
    ages = low + (high - low) * (np.arange(n) + 0.5) / n
    return [
        PhantomHead(
            name=f"{motion}-{ages[k]:.1f}w-{first_seed + k}",
            volume=f"phantom-{ages[k]:.1f}w",
            motion=motion,
            seed=first_seed + int(k),
            weeks=float(ages[k]),
        )
        for k in spread_order(n)
    ]


def atlas_heads(
    n: int, motion: str, atlas: Path, include: Sequence[str] = (), first_seed: int = FIRST_SEED
) -> list[PaperSubject]:
    """Volumes of an atlas folder between 21 and 38 weeks, by age.

    Args:
        n: largest number of volumes.
        motion: level of motion.
        atlas: folder of subjects; see `find_subjects`.
        include: glob patterns of names; an empty list takes all.
        first_seed: seed of the first; each has its own.

    Raises:
        InputError: no volume is of such an age.
    """
    aged = sorted((weeks_of(one), one.name) for one in find_subjects(atlas, include))
    found = [(weeks, name) for weeks, name in aged if WEEKS[0] <= weeks <= WEEKS[1]]
    if not found:
        raise InputError(f"--atlas {atlas}: no volume of 21 to 38 weeks; expected folders such as sta27")
    listed = [
        PaperSubject(
            name=f"{motion}-{name.replace('/', '-')}-{first_seed + k}",
            volume=name,
            motion=motion,
            seed=first_seed + k,
            weeks=weeks,
        )
        for k, (weeks, name) in enumerate(found)
    ]
    return [listed[k] for k in spread_order(len(listed))][:n]


def spread_order(n: int) -> list[int]:
    """The numbers below n in an order in which the first few are far apart: 0, then halves, quarters and so on."""
    step = 1 << max(0, (n - 1).bit_length())
    order = [0] if n else []
    while step > 1:
        step //= 2
        order += [k for k in range(step, n, 2 * step)]
    return order


def paper_case(spec: PaperSubject, atlas: Path | None, cache: Path, n_stacks: int | None = None) -> SimulatedCase:
    """A subject, simulated if the cache lacks it.

    Args:
        spec: the subject.
        atlas: folder of its volume; None for a phantom.
        cache: folder of simulated subjects.
        n_stacks: number of its first stacks to use; None for all.
    """
    return read_case(simulated_subject(spec, atlas, cache), n_stacks)
