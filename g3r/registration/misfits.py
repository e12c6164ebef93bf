"""Stacks that do not fit the others: found once all are registered, left out, and the others registered anew."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration.estimate import Registration, register
from g3r.registration.quality import stack_qualities
from g3r.registration.settings import RegistrationSettings
from g3r.registration.stack_quality import StackQuality, unlike_others
from g3r.run.deadline import Deadline

logger = logging.getLogger(__name__)


def register_robustly(
    slices: Slices,
    settings: RegistrationSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    template: AtlasTemplate | None = None,
    proposals: Mapping[str, RigidPose] | None = None,
    deadline: Deadline | None = None,
) -> Registration:
    """Poses of all slices as `register` finds them, without stacks that do not fit the others.

    A stack of another head or contrast, or one whose slices went astray, draws its errors into the volume, and the
    slices of good stacks towards them. It is left out where most stacks fit, and all of these once they are registered
    without it. Otherwise all stay: it cannot be said which ones are right.

    Args:
        slices: see `register`.
        settings: see `register`; `leave_out_misfits` is asked here.
        progress: see `register`; called once more from the start where stacks are left out.
        template: see `register`.
        proposals: see `register`.
        deadline: see `register`.
    """
    found = register(slices, settings, progress, template=template, proposals=proposals, deadline=deadline)
    if not settings.leave_out_misfits:
        return found
    numbers, qualities = _present(found)
    out = [numbers[place] for place in misfits(qualities)]
    if not out:
        return found
    kept = np.flatnonzero(~np.isin(slices.stack_id, out))
    logger.info("stacks %s do not fit the others: registration without them", out)
    others = register(
        slices.take(kept),
        settings,
        progress,
        template=template,
        proposals={name: motion.take(kept) for name, motion in (proposals or {}).items()},
        deadline=deadline,
    )
    _, without = _present(others)
    if not all(one.reliable for one in without) or unlike_others(without):
        return found
    beside = dict(zip(numbers, qualities, strict=True))
    return replace(others, left_out=[(n, replace(beside[n], left_out=True)) for n in out])


def misfits(qualities: Sequence[StackQuality]) -> list[int]:
    """Places of stacks that failed or are unlike the others; none where half of all or more are."""
    failed = [n for n, one in enumerate(qualities) if one.reliable is False]
    found = sorted(failed + unlike_others(qualities))
    return found if 2 * len(found) < len(qualities) else []


def _present(registration: Registration) -> tuple[list[int], list[StackQuality]]:
    """Numbers of the stacks that have slices, and their quality."""
    numbers = [int(n) for n in np.unique(registration.slices.stack_id)]
    of_all = stack_qualities(registration, numbers[-1] + 1)
    return numbers, [of_all[n] for n in numbers]
