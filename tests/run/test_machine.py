"""Number of threads: never more than at the start of the process."""

from __future__ import annotations

from collections.abc import Iterator

import numba
import pytest
import torch

from g3r.errors import InputError
from g3r.run.machine import use_threads, use_up_to

OFFERED = int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


@pytest.fixture(autouse=True)
def _same_threads_afterwards() -> Iterator[None]:
    before = torch.get_num_threads(), numba.get_num_threads()
    yield
    torch.set_num_threads(before[0])
    numba.set_num_threads(before[1])


def test_more_threads_than_there_are_are_refused() -> None:
    with pytest.raises(InputError, match=f"this machine offers {OFFERED}"):
        use_threads(OFFERED + 1)


@pytest.mark.parametrize("wanted", [1, OFFERED, OFFERED + 1])
def test_a_measurement_takes_what_there_is(wanted: int) -> None:
    assert use_up_to(wanted) == min(wanted, OFFERED)
    assert torch.get_num_threads() == numba.get_num_threads() == min(wanted, OFFERED)
