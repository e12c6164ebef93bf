"""Steps to convergence, read off a curve."""

import pytest

from studies.tradeoff.convergence import STEPS, WAYS, convergence_table, steps_to_near


def test_steps_are_interpolated_on_their_logarithm():
    assert steps_to_near([10, 40], [20.0, 22.0], 21.1) == pytest.approx(20.0)


def test_a_curve_that_is_there_from_the_start_or_never():
    assert steps_to_near([10, 40], [22.0, 22.0], 22.05) == 10
    assert steps_to_near([10, 40], [20.0, 21.0], 22.0) is None


def test_the_table_names_every_way_and_says_never():
    entries = [{"steps": n, "psnr_db": 20.0 + k, "n_gaussians": 7, "cpu_s": float(n)} for k, n in enumerate(STEPS)]
    low = [entry | {"psnr_db": entry["psnr_db"] - 3} for entry in entries]
    ways = dict.fromkeys(WAYS, low) | {"few Gaussians first (as shipped)": entries}
    text = convergence_table({"preset": "balanced", "cases": {"one": ways}})
    assert all(name in text for name in WAYS)
    assert text.count("never") == len(WAYS) - 1
