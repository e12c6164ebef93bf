"""Worker process of a study."""

from __future__ import annotations

import multiprocessing
import os
from threading import Thread

from g3r.run.machine import use_up_to


def begin_worker(threads: int) -> None:
    """Set the threads of this process, and end it when its parent process ends, even if the parent was killed.

    Args:
        threads: largest number of threads.
    """
    use_up_to(threads)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None  # a worker always has a parent process
    parent.join()
    os._exit(1)
