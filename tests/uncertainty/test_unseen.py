"""Messages about the unseen part of the brain."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.uncertainty.unseen import DO_NOT_USE_ABOVE, MENTIONED_ABOVE, UnseenPart

BRAIN = np.zeros((20, 20, 20), bool)
BRAIN[5:15, 5:15, 5:15] = True  # 1000 voxels


def part(n_unseen: int, shown: str = "estimate from other brains", voxel_mm3: float = 8.0) -> UnseenPart:
    unseen = np.zeros_like(BRAIN)
    unseen[tuple(np.argwhere(BRAIN)[:n_unseen].T)] = True
    return UnseenPart.of(unseen, BRAIN, voxel_mm3, shown=shown)


def test_share_and_volume() -> None:
    found = part(125)
    assert found.share == pytest.approx(0.125)
    assert found.volume_ml == pytest.approx(1.0)
    assert found.usable
    line = found.line()
    assert line == "12 % of the brain was not seen by any slice (1 ml): it is shown as an estimate from other brains"


@pytest.mark.parametrize(
    ("shown", "words"),
    [
        ("estimate from other brains", "it is shown as an estimate from other brains"),
        ("smooth continuation", "it is shown as a smooth continuation"),
        ("blank", "it was left blank"),
    ],
)
def test_it_is_said_what_is_shown(shown: str, words: str) -> None:
    line = part(200, shown).line()
    assert line is not None
    assert line.startswith("20 % of the brain was not seen by any slice (2 ml)")
    assert line.endswith(words)


def test_slivers_are_not_mentioned_and_small_shares_have_a_decimal() -> None:
    limit = round(1000 * MENTIONED_ABOVE)
    assert part(0).line() is None
    assert part(limit - 1).line() is None
    line = part(limit).line()
    assert line is not None
    assert line.startswith("0.5 % of the brain")


def test_too_much_must_not_be_used() -> None:
    limit = round(1000 * DO_NOT_USE_ABOVE)
    assert part(limit).usable
    line = part(limit).line()
    assert line is not None
    assert "do not use" not in line
    over = part(limit + 1)
    assert not over.usable
    line = over.line()
    assert line is not None
    assert line.endswith("; do not use this volume")


def test_no_brain_is_no_division_by_zero() -> None:
    nothing = UnseenPart.of(0 * BRAIN > 0, 0 * BRAIN > 0, 1.0, shown="blank")
    assert nothing.share == 0
    assert nothing.line() is None


def test_a_cut_head_of_unknown_size_must_not_be_used() -> None:
    """This holds however small the unseen share of the mask is."""
    nothing = np.zeros_like(BRAIN)
    found = UnseenPart.of(nothing, BRAIN, 8.0, shown="smooth continuation", share_by_areas=0.43, has_template=False)
    assert found.share == 0
    assert not found.usable
    line = found.line()
    assert line is not None
    assert "about 40 % of the brain lies beyond" in line
    assert line.endswith("do not use this volume")


def test_the_size_of_a_cut_head_is_that_of_a_template_that_fits() -> None:
    found = UnseenPart.of(BRAIN, BRAIN, 8.0, shown="estimate from other brains", share_by_areas=0.43)
    assert found.extent_known
    line = found.line()
    assert line is not None
    assert line.startswith("100 % of the brain was not seen")
