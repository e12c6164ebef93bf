"""A masker of the user: a command that is run once per stack, and whose mask is checked like a given one."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from g3r.acquisition.brain_mask import FoundMask
from g3r.acquisition.images import Volume, load_mask
from g3r.errors import InputError

STACK, MASK = "{stack}", "{mask}"
"""Placeholders for the file of the stack and for the file that the command has to write."""

PLACE = re.compile("|".join(map(re.escape, (STACK, MASK))))

FOLDERS = re.compile(r"[^=:,;]*[/\\]")
"""Folders in a word of a command line, before a file name: at its beginning, after an option's = or in a list."""

TIMEOUT_S = 900.0
"""Time limit of a masker for one stack: published networks take up to two minutes for a stack without a GPU."""

MAX_SAID = 300
"""Most characters of a command's output that are quoted in a message."""


@dataclass(frozen=True)
class MaskCommand:
    """A command line with `{stack}` and `{mask}` in it, run without a shell.

    Args:
        line: the command line.
        timeout_s: seconds after which it is ended.

    Raises:
        InputError: it cannot be split into words, or lacks one of the two placeholders.
    """

    line: str
    timeout_s: float = TIMEOUT_S

    def __post_init__(self) -> None:
        try:
            words = shlex.split(self.line)
        except ValueError as error:
            raise InputError(f"--mask-command: {error} in {self.line!r}; quote it as a shell would want it") from None
        missing = [place for place in (STACK, MASK) if not any(place in word for word in words)]
        if missing:
            raise InputError(
                f"--mask-command: no {' and no '.join(missing)} in {self.line!r}; expected a command such as "
                f"'tool --input {STACK} --output {MASK}'"
            )

    def mask_of(self, path: str | os.PathLike[str], volume: Volume) -> FoundMask:
        """The mask that the command makes of a stack.

        Args:
            path: path of the stack.
            volume: image read from it.

        Raises:
            InputError: the command cannot be started, fails or takes too long, or it writes no mask of this stack.
        """
        with tempfile.TemporaryDirectory(prefix="g3r-mask-") as folder:
            target = Path(folder) / "mask.nii.gz"
            places = {STACK: os.path.abspath(path), MASK: str(target)}
            words = [PLACE.sub(lambda found: places[found[0]], word) for word in shlex.split(self.line)]
            self._run(words, volume.name)
            if not target.is_file():
                raise InputError(f"{volume.name}: --mask-command ended well but wrote no {MASK}; check {self.line!r}")
            try:
                inside = load_mask(target, volume)
            except InputError as error:
                raise InputError(f"{volume.name}: --mask-command wrote a mask that cannot be used: {error}") from None
        return FoundMask(inside=inside, source="command", detail=self.told())

    def told(self) -> str:
        """The command line for records, without folders, because they may name patients."""
        return " ".join(FOLDERS.sub("", word) for word in shlex.split(self.line))

    def _run(self, words: list[str], name: str) -> None:
        try:
            process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,  # so that its children can be ended with it
            )
        except (OSError, ValueError) as error:
            found = getattr(error, "strerror", None) or error
            raise InputError(
                f"{name}: --mask-command cannot be started ({found}): {words[0]}; check its path"
            ) from None
        try:
            said, complained = process.communicate(timeout=self.timeout_s)
        except BaseException as error:  # Ctrl-C, too
            _end(process)
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
            raise InputError(
                f"{name}: --mask-command did not end within {self.timeout_s:g} s and was stopped; try it alone, or "
                "raise --mask-timeout"
            ) from None
        if process.returncode:
            raise InputError(
                f"{name}: --mask-command failed with exit code {process.returncode}{_last_words(complained, said)}; "
                "try it alone"
            )


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process and its children."""
    with suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
    process.wait()
    for pipe in (process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()


def _last_words(*outputs: bytes) -> str:
    """The last line of the first output that has one. Pass stderr first: a program may print more after its error."""
    for output in outputs:
        lines = [line for line in output.decode(errors="replace").splitlines() if line.strip()]
        if lines:
            return f": {lines[-1].strip()[-MAX_SAID:]}"
    return " and said nothing"
