"""Output of g3r-infer: a line per stage, the verdict last, a bar on a terminal, everything in log.txt."""

from __future__ import annotations

import json
import logging
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from g3r.cli import terminal
from g3r.cli.infer import main
from g3r.cli.infer_options import build_parser
from g3r.errors import NumericalError
from g3r.reconstruct import GaussianReconstructor
from g3r.report.stage_words import DOING
from tests.faults.small_case import SmallCase, make_small_case, names
from tests.rooms import REPOSITORY

STAGES = [
    "finding the brain: your 3 masks will be used",
    "reading the stacks: 3 stacks, ",
    "finding the head: only 1 of 3 stacks agree",  # because the registration in this test is so short
    "following the motion: ",
    "first volume: ",
    "comparing with other brains: not done",
    "building the volume: made of ",
    "fitting to the slices: ",
    "making the volume: 2 mm voxels, a brain of ",
    "estimating the errors: ",
    "writing the files: done",
]


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> SmallCase:
    return make_small_case(tmp_path_factory.mktemp("case"))


def loud(case: SmallCase, output: Path, *further: str) -> list[str]:
    """The arguments of the quick run without --quiet."""
    return [word for word in case.arguments(output, *further) if word != "--quiet"]


def begins(lines: list[str], expected: list[str]) -> bool:
    return len(lines) == len(expected) and all(map(str.startswith, lines, expected))


def test_a_line_per_stage_and_the_verdict_last(
    case: SmallCase, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(loud(case, tmp_path / "out")) == 0
    said = capsys.readouterr()
    lines = said.err.splitlines()
    assert begins([line for line in lines if not line.startswith("g3r-infer: ")], STAGES), said.err
    assert "\x1b" not in said.out + said.err  # no terminal: no bar, no colour
    assert said.out.splitlines()[-1].startswith("verdict: ")
    assert all(len(line) <= 80 for line in lines if not line.startswith("g3r-infer: "))


def test_quiet_leaves_the_result(case: SmallCase, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(case.arguments(tmp_path / "out")) == 0
    said = capsys.readouterr()
    for name, warning in zip(("stack-0", "stack-1"), said.err.splitlines(), strict=True):
        assert warning.startswith(f"g3r-infer: {name}.nii.gz: registration probably failed")
    assert said.out.splitlines()[0] == f"volume:  {tmp_path / 'out' / 'volume.nii.gz'}"
    assert (tmp_path / "out" / "log.txt").is_file()


def test_verbose_has_the_developers_detail(case: SmallCase, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(loud(case, tmp_path / "out", "--verbose")) == 0
    lines = capsys.readouterr().err.splitlines()
    assert begins([line for line in lines if not line.startswith(("  ", "g3r-infer: "))], STAGES)
    assert any(re.match(r"  slices, round 1: voxel .* residual", line) for line in lines)


def test_the_log_has_everything_with_times_and_no_folder(case: SmallCase, tmp_path: Path) -> None:
    levels = [logging.getLogger(name).level for name in (None, "g3r")]
    assert main(case.arguments(tmp_path / "out")) == 0
    text = (tmp_path / "out" / "log.txt").read_text()
    lines = text.splitlines()
    assert all(re.match(r"\d\d:\d\d:\d\d +\d+\.\d\d s  ", line) for line in lines)
    said = [line.split(" s  ", 1)[1] for line in lines]
    assert said[0].startswith("g3r-infer ")
    assert said[1].startswith("options: --stacks stack-0.nii.gz stack-1.nii.gz stack-2.nii.gz --masks mask-0.nii.gz")
    assert begins([line for line in said if line.split(":")[0] in DOING.values()], STAGES)
    assert any(line.startswith("g3r.registration.slice_rounds: slices, round 1") for line in said)
    assert said[-1].startswith("verdict: ")
    assert str(tmp_path) not in text
    assert str(case.folder) not in text
    assert [logging.getLogger(name).level for name in (None, "g3r")] == levels


def test_a_run_that_fails_leaves_its_log_with_its_stages(
    case: SmallCase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*arguments: object) -> None:
        raise NumericalError("the fit broke down; lower the step sizes")

    with monkeypatch.context() as patch:
        patch.setattr(GaussianReconstructor, "_fit_to_prior", fails)
        assert main(case.arguments(tmp_path / "out")) == 4
    assert names(tmp_path) == {"out.unfinished"}
    text = (tmp_path / "out.unfinished" / "log.txt").read_text()
    assert "NumericalError: the fit broke down" in text
    assert str(tmp_path) not in text
    assert main(case.arguments(tmp_path / "out", "--resume")) == 0
    assert names(tmp_path) == {"out"}
    assert (
        "finding the head: only 1 of 3 stacks agree (from the earlier run)"
        in (tmp_path / "out" / "log.txt").read_text()
    )


def test_a_refusal_is_one_line_and_writes_no_log(
    case: SmallCase, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "text.nii").write_text("hello")
    assert main(["--stacks", str(tmp_path / "text.nii"), "--whole-image", "--output", str(tmp_path / "out")]) == 3
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert names(tmp_path) == {"text.nii"}


def test_the_bar_begins_before_anything_is_loaded(case: SmallCase, tmp_path: Path) -> None:
    code = f"""
import json, sys
import g3r.cli.terminal as terminal
enter, seen = terminal.Terminal.__enter__, []
heavy = {{"torch", "numba", "numpy", "scipy", "nibabel", "monai", "rich"}}
def begin(self):
    seen.extend(heavy & set(sys.modules))
    return enter(self)
terminal.Terminal.__enter__ = begin
from g3r.cli.infer import main
code = main({[*loud(case, tmp_path / "out"), "--dry-run"]!r})
print(json.dumps([code, seen]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=REPOSITORY)
    assert json.loads(done.stdout.splitlines()[-1]) == [0, []]


def test_the_bar_ends_when_everything_is_written(
    case: SmallCase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there: list[set[str]] = []
    end = terminal.Terminal.end_bar

    def look(self: terminal.Terminal) -> None:
        there.append(names(tmp_path))
        end(self)

    monkeypatch.setattr(terminal.Terminal, "end_bar", look)
    assert main(case.arguments(tmp_path / "out")) == 0
    assert there[0] == {"out"}


def on_a_terminal(arguments: list[str], **environment: str) -> str:
    """Output of the command on a terminal of 80 columns."""
    pty = pytest.importorskip("pty")
    import fcntl
    import struct
    import termios

    ours, theirs = pty.openpty()
    fcntl.ioctl(ours, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 80, 0, 0))
    variables = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "NO_COLOR")}
    variables |= {"TERM": "xterm-256color", "PYTHONPATH": str(REPOSITORY), **environment}
    line = [sys.executable, "-m", "g3r.cli.infer", *arguments]
    with subprocess.Popen(line, stdout=theirs, stderr=theirs, stdin=theirs, env=variables, cwd=REPOSITORY) as process:
        os.close(theirs)
        said = bytearray()
        while True:
            try:
                part = os.read(ours, 65536)
            except OSError:  # how Linux reports that the other end is closed
                break
            if not part:
                break
            said += part
    os.close(ours)
    assert process.returncode == 0, said.decode()
    return said.decode()


def test_a_terminal_has_a_bar_with_the_time_left_and_a_coloured_verdict(case: SmallCase, tmp_path: Path) -> None:
    said = on_a_terminal(loud(case, tmp_path / "out"))
    assert said.index("starting") < said.index("% ") < said.index("left") < said.index("reading the stacks: 3 stacks")
    last = said.rstrip().splitlines()
    assert any(re.match(r"(\x1b\[\?25h|\x1b\[2K|\x1b\[1A|\r)*\x1b\[1;3[123]mverdict: ", line) for line in last[-8:])


def test_no_color_is_respected(case: SmallCase, tmp_path: Path) -> None:
    said = on_a_terminal(loud(case, tmp_path / "out"), NO_COLOR="1")
    assert "left" in said
    assert not re.search(r"\x1b\[[\d;]*3[0-9]m", said)


def test_a_dumb_terminal_has_lines_alone(case: SmallCase, tmp_path: Path) -> None:
    said = on_a_terminal(loud(case, tmp_path / "out"), TERM="dumb")
    assert "\x1b" not in said.removesuffix("\x1b[0m")  # colorama's reset at exit, loaded by some library
    assert "finding the head: only 1 of 3 stacks agree" in said


def test_help_is_in_groups_with_defaults_and_three_examples_at_80_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = build_parser().format_help()
    assert all(len(line) <= 80 for line in text.splitlines())
    headings = re.findall(r"^(\w[\w ]*):$", text, flags=re.MULTILINE)
    assert headings[:2] == ["stacks", "what is brain"]
    assert len(headings) == 7
    assert len(re.findall(r"^    g3r-infer ", text, flags=re.MULTILINE)) == 3
    for default in ("(default: balanced", "(default: 0.8)", "(default: standard)", "(default: fill)", "(default: 0)"):
        assert default in text
    assert not re.search(r"^\s*options:$", text, flags=re.MULTILINE)


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("g3r-infer --pre", {"--preset "}),
        ("g3r-infer --preset ", {"preview", "fast", "balanced", "accurate"}),
        ("g3r-infer --output {folder}/", {"{folder}/deep/"}),
        ("g3r-infer --config {folder}/", {"{folder}/deep/", "{folder}/run.json"}),
    ],
)
def test_the_shell_completes_options_and_files(line: str, offered: set[str], tmp_path: Path) -> None:
    pytest.importorskip("argcomplete")
    (tmp_path / "deep").mkdir()
    (tmp_path / "run.json").touch()
    line = line.format(folder=tmp_path)
    answer = tmp_path / "answer"
    variables = os.environ | {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(answer),
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
        "COMP_TYPE": "9",
    }
    subprocess.run([sys.executable, "-m", "g3r.cli.infer"], env=variables, check=False, cwd=REPOSITORY)
    assert set(answer.read_text().split("\n")) == {one.format(folder=tmp_path) for one in offered}
