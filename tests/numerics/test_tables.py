"""The tables of docs/numerics.md: their figures are within bounds, and the document agrees with them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tests.numerics import tables as numerics
from tests.numerics.errors import (
    comb,
    distance_rows,
    gradient_rows,
    gradient_tolerance,
    pixel_rows,
    shape_rows,
    shape_tolerance,
    size_rows,
)
from tests.tally import Tally

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "numerics.md"
FLOAT32 = ("reference float32", "numba")


def written(name: str) -> str:
    text = DOCUMENT.read_text(encoding="utf-8")
    return text.split(f"<!-- numerics-{name}:begin -->")[1].split(f"<!-- numerics-{name}:end -->")[0].strip()


def assert_written(name: str, table: str, factor: float = 4.0) -> None:
    """Assert that the document has the same words, and numbers within a factor (rounding differs between machines)."""
    number = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]\d+)?")
    found, expected = written(name), table.strip()
    # neither the width of numbers nor their presence matters
    assert number.sub("#", found) == number.sub("#", expected), name
    for a, b in zip(number.findall(found), number.findall(expected), strict=True):
        a, b = abs(float(a)), abs(float(b))
        assert a == b or max(a, b) <= factor * min(a, b) or max(a, b) < 1e-9, (name, a, b)


def test_values_by_axis_ratio(tally: Tally) -> None:
    rows = shape_rows()
    for row in rows:
        with tally.case():
            for name in FLOAT32:
                assert row[name] <= shape_tolerance(row["ratio"]), (name, row)
            # quadrature to 6.5 sigma; V(x) loses eps times the ratio in any dtype
            assert row["float64"] <= 2e-10 if row["psf"] else row["float64"] <= 1e-14 + 1e-15 * row["ratio"]
        if row["ratio"] >= 1000:  # the naive formulas fail here
            assert not row["naive float32"] < 0.1
            assert not row["naive float32, epsilon"] < 0.1
    assert_written("shape", numerics.shape_table(rows))


@pytest.mark.numerics
def test_gradients_by_axis_ratio(tally: Tally) -> None:
    rows = gradient_rows()
    for row in rows:
        for name in ("centre", "shape", "amplitude", "turn", "shift", "gain"):
            with tally.case():
                assert row[name] <= gradient_tolerance(row["ratio"]), (name, row)
    assert_written("gradient", numerics.gradient_table(rows), 8.0)


def test_values_by_size_and_thickness(tally: Tally) -> None:
    rows = size_rows()
    for row in rows:
        for name, error in row.items():
            if name not in ("sigma_mm", "epsilon"):
                with tally.case():
                    assert error <= shape_tolerance(1.5), (name, row)
    assert rows[0]["epsilon"] > 1  # the naive value at 0.02 mm is meaningless
    assert rows[-1]["epsilon"] < 1e-9
    assert_written("size", numerics.size_table(rows))


def test_what_samples_show_of_gaussians_below_a_pixel(tally: Tally) -> None:
    rows = pixel_rows()
    for row in rows:
        for name in ("volume", "slices"):
            with tally.case():
                low, high = row[f"{name} lower bound"], row[f"{name} upper bound"]
                # the exponential is exact to 2e-7 of an amplitude, and an amplitude shows `high` times the mass
                assert row[f"{name} least"] >= low * (1 - 1e-5) - 3e-6 * max(1.0, high)
                assert row[f"{name} most"] <= high * (1 + 1e-4)
                # the bounds are reached on a sample and between samples
                assert row[f"{name} most"] == pytest.approx(high, rel=1e-4)
    slices = [row for row in rows if row["ratio"] <= 0.1]
    assert all(row["slices least"] > 0.92 and row["slices most"] < 1.085 for row in slices)
    assert_written("pixel", numerics.pixel_table(rows), 1.01)


def test_a_comb_of_samples_by_poissons_formula() -> None:
    for sigma in (0.2, 0.5, 1.0):
        for phase in (0.0, 0.2, 0.5):
            m = np.arange(1, 30)
            poisson = 1 + 2 * (np.exp(-2 * (np.pi * sigma * m) ** 2) * np.cos(2 * np.pi * m * phase)).sum()
            assert comb(sigma, phase) == pytest.approx(poisson, rel=1e-12)


def test_values_by_distance_from_the_origin(tally: Tally) -> None:
    rows = distance_rows()
    for row in rows:
        with tally.case():
            # positions of planes are float64: eps of the distance, relative to a sigma of 1 mm
            assert row["reference float64"] <= 1e-13 + 1e-15 * 1e3 * row["distance_m"]
            for name in FLOAT32:
                assert row[name] <= shape_tolerance(3.0), (name, row)
    assert rows[-1]["naive float32"] > 3e-4  # float32 resolves 60 m along an axis to 2 um
    assert_written("distance", numerics.distance_table(rows))


@pytest.mark.parametrize("name", numerics.TABLES)
def test_the_document_has_every_table(name: str) -> None:
    lines = written(name).splitlines()
    assert len(lines) >= 4
    assert all(line.startswith("|") for line in lines)


def test_the_command_writes_a_table_between_its_markers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = tmp_path / "numerics.md"
    document.write_text("before\n<!-- numerics-distance:begin -->\nold\n<!-- numerics-distance:end -->\nafter\n")
    options = ["--only", "distance", "--docs", str(document), "--output", str(tmp_path / "out")]
    assert numerics.main(options) == 0
    text = document.read_text()
    assert "old" not in text
    assert text.startswith("before")
    assert text.endswith("after\n")
    assert "| distance, m |" in text
    assert (tmp_path / "out" / "numerics.json").is_file()
