"""What a run has on disk before its result is whole: a folder beside the output, locked while it lives.

`DIR.unfinished` holds the stages that are done (`g3r.run.stage_store`) and the result while it is being written. The
lock goes with the process however that ends, so an unlocked folder is a dead run's, and the next run to the
same output may take what it finds there or remove it. Nothing of a living run is ever touched.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType

from g3r.errors import InputError, cannot_be_written

SUFFIX = ".unfinished"


class OutputFolder:
    """The folder of one run; use it as a context, which holds the lock.

    At the end the folder goes, unless `stages` holds something to go on from.

    Args:
        output: folder that the result will be.
        names: of files that a result may have; others that lie in an earlier result are kept. None replaces
            the whole folder.

    Raises:
        InputError: another run is writing the same output, or the folder cannot be made.
    """

    def __init__(self, output: str | os.PathLike[str], names: Collection[str] | None = None) -> None:
        self.named = Path(output)
        self.output = Path(os.path.realpath(output))  # a link is followed, not replaced
        self.folder = self.output.with_name(self.output.name + SUFFIX)
        self.stages = self.folder / "stages"
        self.names = names
        self._whole, self._earlier = self.folder / "whole", self.folder / "earlier"
        self._lock: int | None = None
        self._made: list[Path] = []

    def __enter__(self) -> OutputFolder:
        parents = [self.folder.parent, *self.folder.parent.parents]
        self._made = [path for path in parents if not path.exists()]
        try:
            self._lock = self._take_lock()
            self._clean()
        except OSError as error:
            self._let_go()
            raise cannot_be_written(self.folder, error) from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):
            self._clean()
            if not (self.stages.is_dir() and any(self.stages.glob("*.npz"))):
                shutil.rmtree(self.folder, ignore_errors=True)
        self._let_go()

    def forget_stages(self) -> None:
        """Remove the stages: the result is whole, or the run starts anew."""
        shutil.rmtree(self.stages, ignore_errors=True)

    def make_room(self, needed_bytes: int) -> None:
        """Give the stages up where only that leaves enough space for the result."""
        kept = sum(path.stat().st_size for path in self.stages.glob("*"))
        free = shutil.disk_usage(self.folder).free
        if free < needed_bytes <= free + kept:
            self.forget_stages()

    @contextmanager
    def result(self) -> Iterator[Path]:
        """A folder to write a result into; it becomes the output at the end, or is gone if writing fails.

        An earlier result steps aside first and is removed afterwards.

        Raises:
            OSError: it cannot be put in place.
        """
        assert self._lock is not None, "enter first"
        shutil.rmtree(self._whole, ignore_errors=True)
        try:
            self._whole.mkdir()
            yield self._whole
            for path in self._whole.iterdir():  # a full disk may say so no sooner
                _to_disk(path)
            if self.output.exists():
                os.rename(self.output, self._earlier)
            os.rename(self._whole, self.output)
        finally:
            self._clean()

    def _clean(self) -> None:
        """Remove a result that was not finished; finish or undo the exchange of an earlier one."""
        shutil.rmtree(self._whole, ignore_errors=True)
        if not self._earlier.exists():
            return
        if not self.output.exists():
            os.rename(self._earlier, self.output)
            return
        for path in self._earlier.iterdir():
            own = self.names is None or path.name in self.names
            if not own and not (self.output / path.name).exists():
                os.rename(path, self.output / path.name)
        shutil.rmtree(self._earlier, ignore_errors=True)

    def _take_lock(self) -> int:
        while True:
            self.folder.mkdir(parents=True, exist_ok=True)
            path = self.folder / "lock"
            lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                    process = os.read(lock, 20).decode(errors="replace").strip() or "unknown"
                    os.close(lock)
                    raise InputError(
                        f"{self.named}: another run is writing it (process {process}); wait for it, or "
                        "choose another --output"
                    ) from None
                # a file system without locks: nothing can be told about other runs
            if self._is_current(lock, path):
                with suppress(OSError):  # a full disk: then the process is not named
                    os.ftruncate(lock, 0)
                    os.pwrite(lock, str(os.getpid()).encode(), 0)
                return lock
            os.close(lock)  # its run ended and removed the folder in between

    @staticmethod
    def _is_current(lock: int, path: Path) -> bool:
        try:
            return os.path.samestat(os.fstat(lock), path.stat())
        except FileNotFoundError:
            return False

    def _let_go(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        for path in self._made:
            with suppress(OSError):
                path.rmdir()  # only where empty


def _to_disk(path: Path) -> None:
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
