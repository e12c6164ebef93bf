"""Failures of a command, by the user's input or by the machine, as one line and an exit code."""

from __future__ import annotations

import errno
import sys
from collections.abc import Callable

from g3r.errors import G3RError, InputError, NumericalError, cannot_be_written, is_out_of_memory

EXPECTED = (G3RError, MemoryError, RuntimeError, ImportError, OSError)
"""Errors that `line_and_code` may handle; it raises those again that are defects of the program."""

EXTRAS = {
    "evaluate": ("skimage",),
    "train": ("lightning", "torchio", "jsonargparse", "tensorboard"),
    "dicom": ("pydicom", "dcm2niix"),
    "slurm": ("submitit",),
}
"""Import names of the packages of each extra, which only some commands need."""

LESS_MEMORY = "choose a coarser --resolution or --preset preview, or crop the stacks"
KERNEL_CACHE = "free space where the output, temporary files or compiled kernels are kept (NUMBA_CACHE_DIR)"

INTERRUPTED = 130
"""Exit code after Ctrl-C, as in shells."""


def run_command(
    prog: str, work: Callable[[], int], *, interrupted: Callable[[], tuple[str, int]], less_memory: str = LESS_MEMORY
) -> int:
    """Do the work of a command, and print the reason if it fails; returns the exit code.

    Args:
        prog: name of the command.
        work: returns the exit code.
        interrupted: the line for the user after an interruption, and the exit code.
        less_memory: advice for lack of memory.

    Raises:
        BaseException: the error of the work, if it is a defect of the program.
    """
    try:
        return work()
    except KeyboardInterrupt:
        return fail(prog, *interrupted())
    except ModuleNotFoundError as error:
        return fail(prog, missing_extra(error), InputError.exit_code)
    except EXPECTED as error:
        return fail(prog, *line_and_code(error, less_memory))


def fail(prog: str, line: str, exit_code: int) -> int:
    """Print why a command failed; returns the exit code."""
    print(f"{prog}: {line}", file=sys.stderr)
    return exit_code


def line_and_code(error: BaseException, less_memory: str = LESS_MEMORY) -> tuple[str, int]:
    """The line for the user and the exit code.

    Args:
        error: one of `EXPECTED`.
        less_memory: advice for lack of memory.

    Raises:
        BaseException: the error itself, if it is a defect of the program.
    """
    if isinstance(error, G3RError):
        return str(error), error.exit_code
    if is_out_of_memory(error):
        return f"out of memory; {less_memory}", NumericalError.exit_code
    if isinstance(error, OSError):
        if error.filename is not None:
            return str(cannot_be_written(error.filename, error)), InputError.exit_code
        reason = " ".join(str(error.strerror or error).split())
        remedy = f"; {KERNEL_CACHE}" if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) else ""
        return f"a file could not be read or written ({reason}){remedy}", InputError.exit_code
    raise error


def missing_extra(error: ModuleNotFoundError) -> str:
    """The line for the user about a missing package of an extra.

    Raises:
        ModuleNotFoundError: the error itself, if no extra has the package.
    """
    for extra, packages in EXTRAS.items():
        if (error.name or "").split(".")[0] in packages:
            return f"{error.name} is not installed; install the {extra} extra: pip install '.[{extra}]' in a checkout"
    raise error
