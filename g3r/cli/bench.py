"""`g3r-bench`: measure speed against accuracy, the kernels, and how time grows with size."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from importlib import import_module

from g3r._version import __version__
from g3r.cli.failures import INTERRUPTED, run_command

COMMANDS = {
    "kernels": "pair and pixel rates of the renderer, against what the machine can do",
    "scaling": "time and memory as Gaussians, slices, pixels and voxels grow",
    "trade": "seconds and quality of every preset, and of sweeps around one",
}
"""Each command has a module of its name in g3r.bench, with `add_arguments(parser)` and `run(options)`."""


def build_parser() -> argparse.ArgumentParser:
    """The parser of the command's first word, a subcommand that parses the rest itself."""
    lines = "\n".join(f"  {name:<9} {text}" for name, text in COMMANDS.items())
    parser = argparse.ArgumentParser(
        prog="g3r-bench",
        description="Measure g3r on this machine.",
        epilog=f"commands (each has its own --help):\n{lines}\n\n"
        "exit codes: 0 done, 2 usage, 3 bad input, 4 out of memory, 130 interrupted",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help=", ".join(COMMANDS))
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    name = build_parser().parse_args(words[:1]).command
    module = import_module(f"g3r.bench.{name}")
    prog = f"g3r-bench {name}"
    parser = argparse.ArgumentParser(
        prog=prog, description=f"Measure {COMMANDS[name]}.", formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    module.add_arguments(parser)
    options = parser.parse_args(words[1:])
    logging.basicConfig(level=logging.WARNING, format=f"{prog}: %(message)s", stream=sys.stderr)
    line = "interrupted; whatever was measured until now is in --output"
    return run_command(prog, lambda: int(module.run(options)), interrupted=lambda: (line, INTERRUPTED))


if __name__ == "__main__":
    sys.exit(main())
