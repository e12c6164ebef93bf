"""How a command ends: its own code, or one line on stderr with the code of the failure."""

from __future__ import annotations

import errno
from collections.abc import Callable

import pytest

from g3r.cli.failures import INTERRUPTED, LESS_MEMORY, run_command
from g3r.errors import InputError, NumericalError

FAILURES: dict[str, tuple[BaseException, str, int]] = {
    "input": (InputError("a.nii: no image; pass another"), "a.nii: no image; pass another", 3),
    "numbers": (NumericalError("the fit broke down"), "the fit broke down", 4),
    "memory": (MemoryError(), f"out of memory; {LESS_MEMORY}", 4),
    "system": (OSError(errno.EIO, "I/O error"), "a file could not be read or written (I/O error)", 3),
    "extra": (
        ModuleNotFoundError("No module named 'skimage'", name="skimage"),
        "skimage is not installed; install the evaluate extra: pip install '.[evaluate]' in a checkout",
        3,
    ),
    "interruption": (KeyboardInterrupt(), "interrupted; nothing was written", INTERRUPTED),
}


def failing(error: BaseException) -> Callable[[], int]:
    def work() -> int:
        raise error

    return work


def run(work: Callable[[], int]) -> int:
    return run_command("g3r-x", work, interrupted=lambda: ("interrupted; nothing was written", INTERRUPTED))


@pytest.mark.parametrize("name", FAILURES)
def test_a_failure_is_one_line_and_a_code(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    error, line, exit_code = FAILURES[name]
    assert run(failing(error)) == exit_code
    assert capsys.readouterr() == ("", f"g3r-x: {line}\n")


def test_the_code_of_work_that_is_done_stays(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(lambda: 1) == 1
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("defect", [RuntimeError("shapes differ"), ModuleNotFoundError("no a", name="a"), ValueError()])
def test_a_defect_of_the_program_is_raised(defect: Exception) -> None:
    with pytest.raises(type(defect)) as raised:
        run(failing(defect))
    assert raised.value is defect
