"""Reconstruction of the sessions of a data set, by one process of g3r-infer each."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from g3r.bids.dataset import Session, find_masks
from g3r.bids.derivative import RECORD, make_derivative, record_path
from g3r.bids.description import WORK, read_object
from g3r.bids.executor import Ended, Executor, Job
from g3r.bids.outcome import failure_path, log_path, write_failure
from g3r.bids.sidecars import inherited, with_sidecar
from g3r.errors import InputError
from g3r.run.hidden_folders import HiddenFolders
from g3r.run.machine import available_cores

INFER = (sys.executable, "-m", "g3r.cli.infer")

AUTO = "auto"
"""Stands for a mask's file: g3r-infer finds the mask itself."""

THREADS = "--threads"
"""The option of g3r-infer."""

SPEAKER = "g3r-infer: "
"""Prefix of the lines that the command prints."""

DEFECT = 1
"""Exit code of Python after a traceback; g3r-infer has others for what it knows."""

MAX_REASON = 500


@dataclass(frozen=True, kw_only=True)
class Work:
    """The command of one session, with its inputs and its folder.

    Attributes:
        session: session to reconstruct.
        inputs: stacks and masks.
        words: words of the command line.
        folder: folder of this session in the work folder.
    """

    session: Session
    inputs: tuple[Path, ...]
    words: tuple[str, ...]
    folder: Path

    @property
    def result(self) -> Path:
        """Folder that the command writes."""
        return self.folder / "result"

    @property
    def note(self) -> Path:
        """File with the command line of the last run."""
        return self.folder / "command.json"

    def is_done(self) -> bool:
        """Whether exactly this command has written its complete result."""
        try:
            return self.last_words() == self.words and not read_object(self.result / RECORD).get("partial", True)
        except InputError:
            return False

    def last_words(self) -> tuple[str, ...]:
        """The words of its last run; none if it has not run."""
        try:
            words = json.loads(self.note.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return ()
        return tuple(words) if isinstance(words, list) else ()

    def with_threads(self, n_threads: int, *, as_before: bool) -> Work:
        """The command with its number of threads.

        Args:
            n_threads: of its process.
            as_before: whether an earlier run of the same command decides, if this machine has as many cores; its
                stages can only be used with as many threads.
        """
        choices = [n_threads, *(range(1, available_cores() + 1) if as_before else ())]
        works = [replace(self, words=(*self.words, THREADS, str(n))) for n in choices]
        return next((work for work in works if work.words == self.last_words()), works[0])


@dataclass(kw_only=True)
class Cohort:
    """Settings and procedure of the reconstruction of sessions.

    Args:
        bids_dir: the data set.
        out_dir: the derivative data set.
        options: options of g3r-infer, for all sessions.
        whole_image: whether these options say that no mask is needed.
        resumes: whether interrupted runs are resumed.
        force: whether finished sessions are run again.
        mask_derivative: name of the folder in `derivatives/` with the masks; None for any.
        n_threads: threads of each process; None if the options state them.
        threads_may_vary: whether another run of the same command may get another `n_threads`, by what memory is free.
        keep_work: whether all of g3r-infer's files stay in the work folder.
        command: the command that makes a result.
        say: called with a line for each session that starts or ends.
    """

    bids_dir: Path
    out_dir: Path
    options: tuple[str, ...] = ()
    whole_image: bool = False
    resumes: bool = True
    force: bool = False
    mask_derivative: str | None = None
    n_threads: int | None = 1
    threads_may_vary: bool = False
    keep_work: bool = False
    command: tuple[str, ...] = field(default_factory=lambda: INFER)
    say: Callable[[str], None] = lambda line: None

    def run(self, sessions: Sequence[Session], executor: Executor) -> None:
        """Reconstruct the sessions that are not done yet.

        Args:
            sessions: sessions of the data set.
            executor: runs the processes.

        Raises:
            KeyboardInterrupt: a stop was requested; no process is left.
            InputError: the executor cannot run them.
        """
        works = []
        for session in filter(lambda one: one.stacks, sessions):
            has_failed = failure_path(session, self.out_dir).exists()  # perhaps where it was to be replaced
            if record_path(session, self.out_dir).exists() and not has_failed and not self.force:
                self.say(f"{session.stem}: was done before")
                continue
            try:
                work = self._work(session)
            except (InputError, OSError) as error:
                self._failed(session, str(error))
                continue
            if work.is_done() and not self.force:
                self._finish(work)
            else:
                works.append(work)
        jobs = [Job(words=work.words, log=log_path(work.session, self.out_dir)) for work in works]
        if jobs:
            executor.run_all(
                jobs,
                lambda number: self._begin(works[number], executor.begun),
                lambda number, how: self._ended(works[number], how),
            )

    def _work(self, session: Session) -> Work:
        """The command of a session.

        Raises:
            InputError: its masks are ambiguous, or a sidecar cannot be read.
        """
        folder = self.out_dir / WORK / session.stem
        masks = [] if self.whole_image else find_masks(session, self.bids_dir, self.out_dir, self.mask_derivative)
        stacks = [self._with_inherited(stack, folder / "stacks") for stack in session.stacks]
        words = [*self.command, "--stacks", *map(str, stacks)]
        words += ["--masks", *(str(mask or AUTO) for mask in masks)] if masks else []
        words += [*self.options, "--output", str(folder / "result"), "--force"]
        words += ["--resume"] if self.resumes and not self.force else []
        inputs = (*session.stacks, *(mask for mask in masks if mask))
        work = Work(session=session, inputs=inputs, words=tuple(words), folder=folder)
        return work.with_threads(self.n_threads, as_before=self.threads_may_vary) if self.n_threads else work

    def _with_inherited(self, stack: Path, folder: Path) -> Path:
        """The stack; if it inherits sidecar keys, a link to it with a complete sidecar beside it."""
        keys = inherited(stack, self.bids_dir)
        return stack if keys is None else with_sidecar(stack, keys, folder)

    def _begin(self, work: Work, begun: str) -> None:
        """Prepare folders and the note for the process of a session."""
        session = work.session
        failure_path(session, self.out_dir).unlink(missing_ok=True)
        for folder in (log_path(session, self.out_dir).parent, work.folder):
            folder.mkdir(parents=True, exist_ok=True)
        work.note.write_text(json.dumps(work.words), encoding="utf-8")
        self.say(f"{session.stem}: {begun}")

    def _ended(self, work: Work, how: Ended) -> None:
        log = log_path(work.session, self.out_dir)
        if how.code is None:
            self._failed(work.session, f"{how.lost}; see {log.name}", how.seconds)
        elif how.code:
            self._failed(work.session, _reason(log, how.code), how.seconds)
        else:
            self._finish(work)

    def _finish(self, work: Work) -> None:
        """Make the derivative of a session, and remove its work folder."""
        session, staging = work.session, work.folder / "derivative"
        try:
            make_derivative(session, work.result, work.inputs, self.bids_dir, self.out_dir, staging)
            failure_path(session, self.out_dir).unlink(missing_ok=True)
        except (InputError, OSError) as error:
            self._failed(session, str(error))
            return
        if not self.keep_work:
            shutil.rmtree(work.folder, ignore_errors=True)
            with suppress(OSError):
                work.folder.parent.rmdir()  # only where empty
        self.say(f"{session.stem}: done")

    def _failed(self, session: Session, reason: str, seconds: float | None = None) -> None:
        """Print and record why a session failed; the others go on.

        Args:
            session: the failed session.
            reason: why.
            seconds: duration of its process; None without a process, or if unknown.
        """
        hidden = HiddenFolders([str(self.bids_dir), str(self.out_dir)])  # the data set is passed on
        line = " ".join(hidden.left_out_of(reason).split())[:MAX_REASON]
        with suppress(OSError):  # the disk is full: then it is said, at least
            write_failure(session, self.out_dir, line, seconds)
        self.say(f"{session.stem}: failed: {line}")


def _reason(log: Path, code: int) -> str:
    """The reason why a process failed, in one line, from the end of its log."""
    try:
        lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    except OSError:
        lines = []
    # a defect ends with a traceback; lines of the command before it are warnings about other things
    said = [line for line in lines if line.startswith(SPEAKER) and code != DEFECT] or lines[-1:]
    return said[-1].removeprefix(SPEAKER) if said else f"g3r-infer ended with exit code {code} and said nothing"
