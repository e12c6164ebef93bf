"""What the benchmarks' commands have in common: options, and how they end."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable
from pathlib import Path

from g3r.errors import G3RError


def parser_of(name: str, description: str, folder: Path) -> argparse.ArgumentParser:
    """The options that every benchmark has.

    Args:
        name: of the module in `studies`.
        description: for --help.
        folder: where its records go by default.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m studies.{name}",
        description=description,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--preset", default="balanced", help="settings")
    parser.add_argument("--ckpt", metavar="PRIOR.safetensors", help="prior (None: the one shipped)")
    parser.add_argument("--threads", type=int, help="(None: all cores, shared out)")
    parser.add_argument("--output", type=Path, default=folder, help="for the record as JSON and Markdown")
    parser.add_argument("--docs", type=Path, metavar="FILE", help="also put the tables between its markers")
    return parser


def run_command(name: str, run: Callable[[argparse.Namespace], int], options: argparse.Namespace) -> int:
    """Run a benchmark; an error of g3r's ends it with one line and its exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s", stream=sys.stderr)
    try:
        return run(options)
    except G3RError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return error.exit_code
