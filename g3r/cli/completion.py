"""Help formatted for terminals, and completion of options by the shell (argcomplete); see docs/terminal.md."""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Sequence
from typing import Any

MAX_COLUMNS = 100
BOLD, PLAIN = "\x1b[1m", "\x1b[0m"

NIFTI = ("nii", "nii.gz", "gz")
BY_METAVAR = {
    "NIFTI": NIFTI,
    "RUN.json": ("json",),
    "PRIOR.safetensors": ("safetensors",),
    "POSE.safetensors": ("safetensors",),
    "MASK.safetensors": ("safetensors",),
}
"""Endings of the files that an option takes, by its metavar; DIR completes to folders only."""


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Keeps the line breaks of description and examples, and prints headings in bold on a terminal."""

    def __init__(self, prog: str, **options: Any) -> None:
        columns = int(os.environ.get("COLUMNS") or 0) or _columns()
        super().__init__(prog, max_help_position=26, width=min(columns, MAX_COLUMNS) - 1)

    def start_section(self, heading: str | None) -> None:
        """Begin a group of options."""
        bold = heading and sys.stdout.isatty() and not os.environ.get("NO_COLOR")
        super().start_section(f"{BOLD}{heading}{PLAIN}" if bold else heading)


def _columns() -> int:
    try:
        return os.get_terminal_size(sys.stdout.fileno()).columns or 80
    except (OSError, ValueError, AttributeError):
        return 80


def parsed(parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> argparse.Namespace:
    """The parsed command line; where the shell asks for completion, it is answered and the program ends.

    From here on the command can print every file name, also one that the terminal cannot show.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    if "_ARGCOMPLETE" in os.environ:
        complete(parser)
    return parser.parse_args(argv)


def complete(parser: argparse.ArgumentParser) -> None:
    """Answer the shell's request, with files of the right kind for each option."""
    import argcomplete
    from argcomplete.completers import DirectoriesCompleter, FilesCompleter

    for action in parser._actions:
        metavar = action.metavar if isinstance(action.metavar, str) else ""
        if metavar == "DIR":
            action.completer = DirectoriesCompleter()  # type: ignore[attr-defined]
        elif metavar in BY_METAVAR:
            action.completer = FilesCompleter(BY_METAVAR[metavar])  # type: ignore[attr-defined]
    argcomplete.autocomplete(parser)
