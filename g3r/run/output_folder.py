"""The output folder of a run: staged in a locked folder, then put in place as a whole.

`DIR.unfinished` holds the stages that are done (`g3r.run.stage_store`) and the result while it is written. The
lock ends with the process, however that ends. So an unlocked folder belongs to a dead run, and the next run to the
same output may take what it finds there or remove it. Nothing of a living run is ever touched.

Two kinds of DIR stay where they are: a file system of its own (a mount point), onto which nothing can be renamed, and
the folder that the process works in, whose shell would be left in a removed one. There the staging folder is
`DIR/.unfinished`, and the files move one by one, the record last.
"""

from __future__ import annotations

import errno
import os
import shutil
import sys
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from g3r.errors import InputError, cannot_be_written
from g3r.run.atomic_file import sync

SUFFIX = ".unfinished"

FOUND_ON_DISKS = {SUFFIX, "lost+found"}
"""Names that an empty file system may hold."""

NO_LOCKS = {errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP}
"""Errors of file systems without locks; there a file that names its process stands for the lock."""

LAST_NAME = "run.json"
"""Moved last where files move one by one, so that a result that has it is complete."""


class OutputFolder:
    """The output folder of one run, as a context manager that holds the lock.

    On exit the staging folder is removed, unless `stages` holds stages to resume from. `is_written` says whether a
    result of this run is in place.

    Args:
        output: folder of the result.
        names: names of files that a result may have; other files of an earlier result are kept. None replaces
            the whole folder, except what file systems hold of their own (`FOUND_ON_DISKS`).

    Raises:
        InputError: another run is writing the same output, or the folder cannot be made.
    """

    def __init__(self, output: str | os.PathLike[str], names: Collection[str] | None = None) -> None:
        self.named = Path(output)
        self.output = Path(os.path.realpath(output))  # a link is followed, not replaced
        self.stays = self.output.is_dir() and stays(self.output)
        self.staging = self.output / SUFFIX if self.stays else self.output.with_name(self.output.name + SUFFIX)
        self.stages = self.staging / "stages"
        self.names = names
        self.is_written = False
        self._new, self._backup = self.staging / "new", self.staging / "backup"
        self._half_backup, self._replaced = self.staging / "half-backup", self.staging / "replaced"
        self._lock: BaseFileLock | None = None
        self._made: list[Path] = []

    def __enter__(self) -> OutputFolder:
        parents = [self.staging.parent, *self.staging.parent.parents]
        self._made = [path for path in parents if not path.exists()]
        try:
            self._take_lock()
            self._clean()
        except OSError as error:
            self._let_go()
            raise cannot_be_written(self.staging, error) from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):
            self._clean()
            if not (self.stages.is_dir() and any(self.stages.glob("*.npz"))):
                if sys.platform == "win32" and self._lock is not None:  # an open file cannot be removed there
                    self._lock.release()
                shutil.rmtree(self.staging, ignore_errors=True)
        self._let_go()

    def forget_stages(self) -> None:
        """Remove the stored stages, because the result is complete or the run starts anew."""
        shutil.rmtree(self.stages, ignore_errors=True)

    def make_room(self, needed_bytes: int) -> None:
        """Remove the stored stages if only that leaves enough space for the result."""
        kept = sum(path.stat().st_size for path in self.stages.glob("*"))
        free = shutil.disk_usage(self.staging).free
        if free < needed_bytes <= free + kept:
            self.forget_stages()

    @contextmanager
    def result(self) -> Iterator[Path]:
        """A folder to write a result into; it becomes the output at the end, or is removed if writing fails.

        An earlier result is moved aside first and is removed afterwards.

        Raises:
            OSError: the result cannot be put in place.
        """
        assert self._lock is not None, "enter first"
        shutil.rmtree(self._new, ignore_errors=True)
        try:
            self._new.mkdir()
            yield self._new
            for path in self._new.rglob("*"):  # a full disk may be reported only now
                if path.is_file():
                    sync(path)
            if self.stays:
                self._half_backup.mkdir()
                _move_files(self.output, self._half_backup, self.names)
                os.rename(self._half_backup, self._backup)
                _move_files(self._new, self.output)
                os.rename(self._backup, self._replaced)  # from here on the new result is whole
            else:
                if self.output.exists():
                    os.rename(self.output, self._backup)
                os.rename(self._new, self.output)
            self.is_written = True
        finally:
            self._clean()

    def _clean(self) -> None:
        """Remove a result that was not finished; finish or undo the exchange of an earlier one."""
        if self.stays:
            self._clean_mount()
            return
        shutil.rmtree(self._new, ignore_errors=True)
        if not self._backup.exists():
            return
        if not self.output.exists():
            os.rename(self._backup, self.output)
            return
        for path in self._backup.iterdir():
            own = self.names is None or path.name in self.names
            if not own and not (self.output / path.name).exists():
                os.rename(path, self.output / path.name)
        shutil.rmtree(self._backup, ignore_errors=True)

    def _clean_mount(self) -> None:
        """As `_clean`. The backup's name records how far the exchange came, so a clean-up may be cut short, too."""
        if self._backup.exists():  # some of the new files, or all, were moved in
            self._new.mkdir(exist_ok=True)
            _move_files(self.output, self._new, self.names)
            os.rename(self._backup, self._half_backup)
        if self._half_backup.exists():  # nothing new is in the output
            _move_files(self._half_backup, self.output)
        for folder in (self._new, self._half_backup, self._replaced):
            shutil.rmtree(folder, ignore_errors=True)

    def _take_lock(self) -> None:
        path, process = self.staging / "lock", self.staging / "process"
        while self._lock is None:
            self.staging.mkdir(parents=True, exist_ok=True)
            lock: BaseFileLock = FileLock(path, timeout=0)
            try:
                try:
                    lock.acquire()
                except OSError as error:
                    if error.errno not in NO_LOCKS:
                        raise
                    lock = SoftFileLock(path.with_name("lock-by-name"), timeout=0)
                    lock.acquire()
            except Timeout:
                if not Path(lock.lock_file).exists():  # its run ended and removed the folder in between
                    continue
                number = "unknown"
                with suppress(OSError):
                    number = process.read_text(encoding="ascii", errors="replace").strip() or number
                raise InputError(
                    f"{self.named}: another run is writing it (process {number}); wait for it, or "
                    "choose another --output"
                ) from None
            if Path(lock.lock_file).exists():
                self._lock = lock
                with suppress(OSError):  # a full disk: then the process is not named
                    process.write_text(str(os.getpid()), encoding="ascii")
            else:
                lock.release()

    def _let_go(self) -> None:
        if self._lock is not None:
            self._lock.release()
            self._lock = None
        for path in self._made:
            with suppress(OSError):
                path.rmdir()  # only where empty


def is_mount(folder: Path) -> bool:
    """Whether a folder is a mount point, onto which nothing can be renamed."""
    return folder.stat().st_dev != folder.parent.stat().st_dev


def stays(folder: Path) -> bool:
    """Whether a folder must not be renamed: a mount point, or the folder that the process works in."""
    with suppress(OSError):  # the working folder is gone
        return is_mount(folder) or folder.samefile(os.curdir)
    return False


def check_output_folder(
    folder: Path, names: Collection[str], *, replace: bool, inputs: Sequence[str | os.PathLike[str]] = ()
) -> None:
    """Refuse an output that is a file, or a folder that holds files unless they may be replaced.

    Args:
        folder: output folder.
        names: names of files that a result may have.
        replace: whether the folder may hold an earlier result.
        inputs: files that are read; none of them may be overwritten.

    Raises:
        InputError: see above, or a parent in which no folder can be made and renamed.
    """
    try:
        if folder.is_symlink() and not folder.exists():
            raise InputError(f"{folder}: is a link to nothing; remove it or choose another --output")
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file; expected a folder, choose another --output")
        if not replace and folder.exists() and any(path.name not in FOUND_ON_DISKS for path in folder.iterdir()):
            raise InputError(f"{folder}: is not empty; pass --force to replace an earlier result, or choose another")
        target = Path(os.path.realpath(folder))
        parent = next(path for path in target.parents if path.exists())
        if not parent.is_dir():
            raise InputError(f"{folder}: {parent.name} is a file; expected a folder, choose another --output")
        written = [target] if target.exists() else [parent]
        if target.exists() and not stays(target):
            written.append(parent)  # in which the folder is renamed
        if not all(os.access(path, os.W_OK | os.X_OK) for path in written):
            raise InputError(f"{folder}: cannot be written; choose another --output")
        outputs = {(folder / name).resolve() for name in names}
    except (OSError, ValueError, RuntimeError) as error:  # a name too long, a loop of links
        found = getattr(error, "strerror", None) or error
        raise InputError(f"{folder}: cannot be written ({found}); choose another --output") from None
    for path in inputs:
        try:
            is_output = Path(path).resolve() in outputs
        except (OSError, ValueError, RuntimeError):  # its reader reports what is wrong
            continue
        if is_output:
            raise InputError(f"{path}: would be replaced by a result of its name; choose another --output")
    found = sorted(path.name for path in outputs if path.exists())
    is_cut_short = (folder / SUFFIX).exists()  # a mount point, where the record moves last
    if replace and found and LAST_NAME in names and LAST_NAME not in found and not is_cut_short:
        raise InputError(f"{folder}: holds {found[0]}, but no {LAST_NAME} of a result of g3r; choose another --output")


def _move_files(source: Path, target: Path, names: Collection[str] | None = None) -> None:
    """Move files and folders within one file system, the record last; only some names where they are given."""
    found = [path for path in source.iterdir() if path.name not in FOUND_ON_DISKS]
    for path in sorted(found, key=lambda path: path.name == LAST_NAME):
        if names is None or path.name in names:
            os.rename(path, target / path.name)
