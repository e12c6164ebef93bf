"""Thinned pixels are spread evenly, whatever the length of a row."""

import numpy as np
import pytest

from g3r.acquisition.thinning import thinned


@pytest.mark.parametrize(("n", "n_wanted"), [(0, 5), (4, 5), (5, 5), (6, 5), (7, 5), (1000, 999), (12345, 100)])
def test_one_in_each_cell(n: int, n_wanted: int) -> None:
    index = thinned(n, n_wanted)
    assert len(index) == min(n, n_wanted)
    assert (np.diff(index) > 0).all()
    if n > n_wanted:
        assert ((index >= np.arange(n_wanted) * n // n_wanted) & (index < n)).all()
        assert np.diff(index).max() <= 2 * np.ceil(n / n_wanted) - 1
    np.testing.assert_array_equal(index, thinned(n, n_wanted))


@pytest.mark.parametrize(("row", "step"), [(256, 32), (256, 16), (288, 2), (233, 16), (510, 15), (100, 20)])
def test_every_column_is_drawn_about_equally_often(row: int, step: int) -> None:
    """Rows of `row` pixels in 25 square slices; steps of one length would draw 256 / 32 columns alone.

    Rows of 288 and 510 have 144 and 34 cells, and 16 rows of 233 have 233: Fibonacci numbers, whose products with the
    golden ratio are nearly whole.
    """
    n = 25 * row * row
    index = thinned(n, n // step)
    count = np.bincount(index % row, minlength=row)
    np.testing.assert_allclose(count, 25 * row / step, rtol=0.5 if row == 233 else 0.05)
    of_slice = index[index < row**2]
    assert (np.bincount(of_slice % row, minlength=row) > 0).mean() > 0.95
    in_slice = np.bincount(index // row**2, minlength=25)
    assert np.abs(in_slice - row * row / step).max() < 2  # a cell may lie in two slices
