"""Misfits: stacks that do not fit the others. They are left out after registration, and the rest is registered anew."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration.estimate import Registration, register
from g3r.registration.open_strain import crossing_deg
from g3r.registration.quality import nearly_parallel, stack_qualities
from g3r.registration.settings import RegistrationSettings
from g3r.registration.stack_quality import StackQuality, is_mirrored, unlike_others
from g3r.registration.thresholds import IN_PLACE_CORRELATION
from g3r.run.deadline import Deadline
from g3r.run.progress import Progress, no_progress

logger = logging.getLogger(__name__)


def register_robustly(
    slices: Slices,
    settings: RegistrationSettings,
    progress: Progress = no_progress,
    *,
    template: AtlasTemplate | None = None,
    proposals: Mapping[str, RigidPose] | None = None,
    deadline: Deadline | None = None,
) -> Registration:
    """Poses of all slices as `register` finds them, without stacks that do not fit the others.

    A stack of another head or contrast, or one whose slices went astray, draws its errors into the volume, and the
    slices of good stacks towards them. If most stacks fit, the misfits are left out, provided that all others fit once
    they are registered without them. If half of the stacks or more fail, one may have drawn the others with it: each is
    left out in turn. If there is exactly one without which all others agree beyond doubt, it stays out. Otherwise all
    stay, because it is unknown which ones are right.

    Args:
        slices: see `register`.
        settings: see `register`; `leave_out_misfits` is used here.
        progress: see `register`; called anew from the start for each further registration.
        template: see `register`.
        proposals: see `register`.
        deadline: see `register`; stacks are left out in turn only while there is time for one more registration.
    """

    def without(out: Sequence[int]) -> Registration:
        kept = np.flatnonzero(~np.isin(slices.stack_id, out))
        return register(
            slices.take(kept),
            settings,
            progress,
            template=template,
            proposals={name: motion.take(kept) for name, motion in (proposals or {}).items()},
            deadline=deadline,
        )

    begun = time.monotonic()
    found = register(slices, settings, progress, template=template, proposals=proposals, deadline=deadline)
    took_s = time.monotonic() - begun
    if not settings.leave_out_misfits:
        return found
    numbers, qualities = _present(found)
    beside = dict(zip(numbers, qualities, strict=True))
    believed: list[tuple[list[int], Registration]] = []
    if out := [numbers[place] for place in misfits(qualities)]:
        logger.info("stacks %s do not fit the others: registration without them", out)
        others = without(out)
        believed += [(out, others)] if _fits(others) else []
    elif most_failed(qualities):
        for number in numbers:
            if deadline is not None and deadline.part(1.0, reserve_s=took_s).record_whether_passed():
                return found
            logger.info("most stacks do not fit: registration without stack %d", number)
            others = without([number])
            believed += [([number], others)] if _fits(others, beyond_doubt=True) else []
    if len(believed) != 1:
        return found
    ((out, others),) = believed
    return replace(others, left_out=[(n, replace(beside[n], left_out=True)) for n in out])


def misfits(qualities: Sequence[StackQuality]) -> list[int]:
    """Indices of stacks that failed or are unlike the others; none if these are half of all or more."""
    found = sorted(_failed(qualities) + unlike_others(qualities))
    return found if 2 * len(found) < len(qualities) else []


def most_failed(qualities: Sequence[StackQuality]) -> bool:
    """Whether half of the stacks or more failed, with at least three, so that others are left to agree without one."""
    return len(qualities) > 2 and 2 * len(_failed(qualities)) >= len(qualities)


def _failed(qualities: Sequence[StackQuality]) -> list[int]:
    return [n for n, one in enumerate(qualities) if one.reliable is False]


def _fits(registration: Registration, *, beyond_doubt: bool = False) -> bool:
    """Whether all stacks fit each other, and cross at angles large enough to check that.

    Args:
        registration: of these stacks.
        beyond_doubt: whether they must agree as well as stacks in place do, and none may be a mirror image.
    """
    _, qualities = _present(registration)
    if nearly_parallel(crossing_deg(registration.slices)):
        return False
    if beyond_doubt and any(
        is_mirrored(one) or (one.held_out_correlation or 0.0) < IN_PLACE_CORRELATION for one in qualities
    ):
        return False
    return all(one.reliable for one in qualities) and not unlike_others(qualities)


def _present(registration: Registration) -> tuple[list[int], list[StackQuality]]:
    """Numbers of the stacks that have slices, and their quality."""
    numbers = [int(n) for n in np.unique(registration.slices.stack_id)]
    of_all = stack_qualities(registration, numbers[-1] + 1)
    return numbers, [of_all[n] for n in numbers]
