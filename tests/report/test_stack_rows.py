"""The table of stacks on the page: what it says of the motion."""

from dataclasses import replace

import pytest

from g3r.report.stack_rows import stack_rows
from tests.report.records import quality, record, stack


@pytest.mark.parametrize(
    ("n_segments", "median_mm", "said"),
    [
        (1, 0.0, ""),
        (1, None, ""),
        (1, 0.34, "0.3 mm from slice to slice"),
        (2, None, "the head jumped once"),
        (4, 2.0, "the head jumped 3 times, 2.0 mm from slice to slice"),
    ],
)
def test_motion_is_told_where_there_was_some(n_segments: int, median_mm: float | None, said: str) -> None:
    one = replace(stack("a.nii", quality(median_move_mm=median_mm)), n_segments=n_segments)
    assert stack_rows(record(one))[0].motion == said
