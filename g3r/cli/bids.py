# PYTHON_ARGCOMPLETE_OK
"""`g3r-bids`: reconstruct every session of a BIDS data set into a derivative data set, with the usage of BIDS Apps."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from g3r._version import __version__
from g3r.cli.completion import parsed
from g3r.cli.failures import run_command
from g3r.cli.infer_options import parsed_options
from g3r.errors import InputError
from g3r.run.hidden_folders import name_alone

if TYPE_CHECKING:
    from g3r.bids.dataset import Session
    from g3r.bids.executor import Executor
    from g3r.bids.slurm_request import SlurmRequest

PROG = "g3r-bids"

FAILED = 1
"""Exit code if a session failed and the others are done."""

OURS = (
    *("stacks", "masks", "output", "force", "resume", "dry_run", "tensorboard"),
    *("dicom_out", "dicom_reference"),  # one examination for all would put every volume under one patient's name
)
"""Options of g3r-infer that this command decides itself, or that make no sense for several sessions."""


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = argparse.ArgumentParser(
        prog=PROG,
        description="Reconstruct every session of a BIDS data set, one process of g3r-infer each, and write a "
        "derivative data set. Sessions that are done are not done again; runs that were cut short go on. For research "
        "only, not for diagnosis.",
        usage="%(prog)s BIDS_DIR OUT_DIR {participant,group} [options] [-- options of g3r-infer]",
        epilog="exit codes: 0 done, 1 a session failed (the others are done), 2 usage, 3 bad input or output, "
        "130 interrupted",
    )
    parser.add_argument(
        "bids_dir", type=_folder, metavar="BIDS_DIR", help="data set; masks are looked for in derivatives/*"
    )
    parser.add_argument("out_dir", type=_folder, metavar="OUT_DIR", help="derivative data set to write")
    parser.add_argument(
        "level",
        choices=("participant", "group"),
        help="reconstruct, or only write participants_g3r.tsv and index.html anew",
    )
    parser.add_argument("--participant-label", nargs="+", metavar="LABEL", help="without sub- (default: all)")
    parser.add_argument("--session-label", nargs="+", metavar="LABEL", help="without ses- (default: all)")
    parser.add_argument("--mask-derivative", metavar="NAME", help="take masks from derivatives/NAME alone")
    parser.add_argument(
        "--jobs",
        type=int,
        metavar="N",
        help="processes at once (default: half the cores, as far as memory is free; with --slurm no limit of ours)",
    )
    parser.add_argument(
        "--slurm",
        type=_slurm_request,
        metavar="partition=NAME[,key=value...]",
        help="run in job arrays of Slurm, a task for each session (needs the slurm extra); keys are options of sbatch, "
        "such as time=60,mem=4G,cpus_per_task=4,account=NAME",
    )
    parser.add_argument("--force", action="store_true", help="do what is done again, and replace it")
    parser.add_argument("--keep-work", action="store_true", help="keep all files of g3r-infer in OUT_DIR/.g3r")
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    cut = words.index("--") if "--" in words else len(words)
    parser = build_parser()
    options = parsed(parser, words[:cut])
    if options.jobs is not None and options.jobs < 1:
        parser.error(f"--jobs {options.jobs}; expected at least 1")
    infer = _infer_options(parser, words[cut + 1 :])
    from g3r.run.idle_threads import let_threads_sleep
    from g3r.run.stop_request import StopRequest

    let_threads_sleep()
    stop_request = StopRequest()

    def work() -> int:
        with stop_request:
            return _run(options, infer, tuple(words[cut + 1 :]), _command(words))

    line = "interrupted; what was done stays, and the same command goes on"
    return run_command(PROG, work, interrupted=lambda: (line, stop_request.exit_code))


def _folder(text: str) -> Path:
    """A folder; absolute where it begins with a dash, which g3r-infer would take for an option."""
    path = Path(text)
    return path.absolute() if str(path).startswith("-") else path


def _slurm_request(text: str) -> SlurmRequest:
    from g3r.bids.slurm_request import parsed_request

    try:
        return parsed_request(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _infer_options(parser: argparse.ArgumentParser, words: Sequence[str]) -> argparse.Namespace:
    """The options for g3r-infer; ends the program with 2 if one of them is not allowed."""
    before = {"stacks": ["STACK"], "output": "DIR"}
    infer = parsed_options(["--stacks", "STACK", "--output", "DIR", *words])
    decided = [name for name in OURS if getattr(infer, name) and getattr(infer, name) != before.get(name)]
    if decided:
        named = ", ".join(f"--{name.replace('_', '-')}" for name in decided)
        parser.error(f"{named} after --: g3r-bids decides that for each session; leave it out")
    return infer


def _command(words: Sequence[str]) -> str:
    """The command line with names of files and folders alone: it stays in a data set that is passed on."""
    return shlex.join([PROG, *map(name_alone, words)])


def _run(options: argparse.Namespace, infer: argparse.Namespace, infer_words: tuple[str, ...], command: str) -> int:
    from g3r.bids.cohort import Cohort
    from g3r.bids.dataset import find_sessions
    from g3r.bids.description import check_data_set, write_data_set

    sessions = find_sessions(options.bids_dir, options.participant_label, options.session_label)
    check_data_set(options.bids_dir, options.out_dir)
    write_data_set(options.bids_dir, options.out_dir, command)
    if options.level == "group":
        return _table(options, sessions)
    for session in sessions:
        if session.left_out:
            print(f"{session.stem}: not read: {', '.join(session.left_out)} (only acq- and run- are, beside ses-)")
    executor, n_threads = _executor(options, infer)
    cohort = Cohort(
        bids_dir=options.bids_dir,
        out_dir=options.out_dir,
        options=infer_words,
        whole_image=infer.whole_image,
        resumes=_keeps_stages(infer),
        force=options.force,
        mask_derivative=options.mask_derivative,
        n_threads=None if infer.threads else n_threads,
        threads_may_vary=options.jobs is None and options.slurm is None,
        keep_work=options.keep_work,
        say=lambda line: print(line, flush=True),
    )
    try:
        cohort.run(sessions, executor)
    finally:
        exit_code = _table(options, sessions)
    return exit_code


def _keeps_stages(infer: argparse.Namespace) -> bool:
    """Whether a run that was cut short can be resumed: none with a time budget, nor the repetition of such a run."""
    from g3r.bids.description import read_object

    if infer.config:
        with suppress(InputError):  # g3r-infer says what is wrong with the file
            return not read_object(Path(infer.config)).get("time_budget")
    return infer.time_budget is None


def _executor(options: argparse.Namespace, infer: argparse.Namespace) -> tuple[Executor, int]:
    """The executor of the processes, and the number of threads of each.

    Raises:
        ModuleNotFoundError: the slurm extra is not installed.
    """
    from g3r.bids.pool import NEEDED_BYTES, LocalPool, default_jobs, threads_each

    needed_bytes = infer.max_memory or NEEDED_BYTES
    if options.slurm is None:
        n_jobs = options.jobs or default_jobs(needed_bytes)
        return LocalPool(n_jobs), threads_each(n_jobs)
    from g3r.bids.description import WORK
    from g3r.bids.slurm import SlurmArrays
    from g3r.bids.slurm_request import CORES

    n_cores = options.slurm.n_cores or infer.threads or CORES
    folder = options.out_dir / WORK / "slurm"
    arrays = SlurmArrays(
        folder=folder, request=options.slurm, n_jobs=options.jobs, n_cores=n_cores, needed_bytes=needed_bytes
    )
    return arrays, n_cores


def _table(options: argparse.Namespace, sessions: list[Session]) -> int:
    """Write the table of all sessions; returns the exit code for the requested sessions."""
    from g3r.bids.dataset import find_sessions
    from g3r.bids.index_page import write_index
    from g3r.bids.outcome import FAILED as FAILED_VERDICT
    from g3r.bids.outcome import outcome_of
    from g3r.bids.table import write_table

    outcomes = [outcome_of(session, options.out_dir) for session in find_sessions(options.bids_dir)]
    path = write_table(outcomes, options.out_dir)
    write_index(outcomes, options.out_dir)
    asked = {session.stem for session in sessions}
    of_asked = [one.verdict for one in outcomes if one.session.stem in asked]
    counts = ", ".join(f"{of_asked.count(verdict)} {verdict}" for verdict in dict.fromkeys(sorted(of_asked)))
    print(f"{path}: {counts}")
    return FAILED if FAILED_VERDICT in of_asked else 0


if __name__ == "__main__":
    sys.exit(main())
