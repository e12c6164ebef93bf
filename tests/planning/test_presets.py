"""Settings of a reconstruction."""

from __future__ import annotations

from dataclasses import replace

import pytest

from g3r.planning.anatomy import GENERIC
from g3r.planning.presets import PRESETS, ReconstructionSettings, changed, for_anatomy, keeping_poses
from g3r.run.json_record import from_plain, to_plain


@pytest.mark.parametrize("name", PRESETS)
def test_one_seed_is_that_of_every_random_choice(name: str) -> None:
    """The search of registration drew by a seed of its own."""
    settings = replace(PRESETS[name], seed=7)
    assert settings.registration.seed == 7
    # whatever record of registration is put in
    assert replace(settings, registration=PRESETS["fast"].registration).registration.seed == 7
    assert changed(settings, {"seed": 3}).registration.seed == 3
    assert keeping_poses(for_anatomy(settings, GENERIC)).registration.seed == 7
    assert from_plain(ReconstructionSettings, to_plain(settings)) == settings


def test_the_usual_seed_is_what_it_was() -> None:
    assert all(one.seed == one.registration.seed == 0 for one in PRESETS.values())
