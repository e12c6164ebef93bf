"""report.html: complete, small, without external requests or patient data, written by the run and by the command."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
import shutil
from importlib.resources import files
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
import pytest

from g3r.cli import infer
from g3r.cli.report import main
from g3r.errors import InputError
from g3r.report import page
from g3r.report.page import SCRIPTS, report_html
from g3r.report.verdict_messages import MESSAGES

MAX_BYTES = 10_000_000

NIIVUE_SHA256 = "47b896b77ec4a5be3ef1949c33ad393b6f45629921f326c279000bcf51bdb4af"
"""SHA-256 of dist/niivue.umd.js in @niivue/niivue 0.69.0."""


def embedded(text: str) -> dict[str, Any]:
    (found,) = re.findall(r'<script type="application/json" id="report-data">(.*?)</script>', text, flags=re.DOTALL)
    return json.loads(found)


def images(text: str) -> dict[str, nib.Nifti1Image]:
    return {
        layer["name"]: nib.Nifti1Image.from_bytes(gzip.decompress(base64.b64decode(layer["data"])))
        for layer in embedded(text)["layers"]
    }


@pytest.fixture(scope="session")
def text(finished: Path) -> str:
    return (finished / "report.html").read_text(encoding="utf-8")


def test_the_vendored_viewer_is_the_published_one_with_its_licence() -> None:
    folder = files("g3r.report") / "page"
    assert hashlib.sha256((folder / "niivue.umd.js").read_bytes()).hexdigest() == NIIVUE_SHA256
    licence = (folder / "niivue.LICENSE.txt").read_text(encoding="utf-8")
    for word in ("BSD 2-Clause", "nifti-reader-js", "gl-matrix", "fflate", "zarrita", "array-equal", "uuid"):
        assert word in licence


def test_the_page_is_one_small_file_that_may_ask_nobody(text: str) -> None:
    assert len(text.encode()) <= MAX_BYTES
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text)
    policy = policy.replace("&#39;", "'")
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "http" not in policy
    assert "script-src" in policy
    assert "'unsafe-inline'" not in policy.split("style-src")[0]
    assert policy.count("'sha256-") == len(SCRIPTS)
    without_scripts = re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
    assert re.findall(r'(?:src|href|url\()\s*=?\s*["\']?(?!data:)\w+:', without_scripts) == []


def test_the_name_is_nowhere_not_even_packed(text: str, finished: Path) -> None:
    words = [b"DOE^", b"JANE", b"pytest-of", str(finished.parent).encode()]
    packed = [image.to_bytes() for image in images(text).values()]
    packed += [base64.b64decode(one) for one in re.findall(r"data:image/png;base64,([^\"]+)", text)]
    # the viewer is third-party code, and base64 text contains short words by chance
    own = text.replace((files("g3r.report") / "page" / "niivue.umd.js").read_text(encoding="utf-8"), "")
    own = re.sub(r"[A-Za-z0-9+/]{200,}={0,2}", "", own)
    assert len(own) < len(text) / 2
    for content in (own.encode(), *packed):
        assert [word for word in words if word in content] == []


def test_the_copies_show_what_the_files_hold(text: str, finished: Path) -> None:
    found = images(text)
    assert set(found) >= {"volume", "mask", "uncertainty", "density", "prior"}
    volume = nib.Nifti1Image.from_filename(finished / "volume.nii.gz")
    copy = found["volume"]
    first = np.rint(np.linalg.solve(volume.affine, copy.affine[:, 3])[:3]).astype(int)
    box = tuple(slice(a, a + n) for a, n in zip(first, copy.shape, strict=True))
    whole, cropped = volume.get_fdata(), copy.get_fdata()
    np.testing.assert_allclose(cropped, whole[box], atol=np.abs(whole).max() / 4000)
    assert whole.sum() == pytest.approx(whole[box].sum(), rel=1e-6)  # the box contains all of it
    assert copy.get_data_dtype() == np.int16
    assert all(found[name].get_data_dtype() == np.uint8 for name in ("mask", "uncertainty", "density", "prior"))


def test_it_says_what_the_terminal_says(finished: Path, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(finished), "--force", "--output", str(finished / "again.html")]) == 0
    said = capsys.readouterr().out.splitlines()[-1]
    (finished / "again.html").unlink()
    word, reasons = said.removeprefix("verdict: ").split(": ", 1)
    assert f"<h1>{word.capitalize()}</h1>" in text
    for reason in reasons.split("; "):
        assert reason[1:] in text.replace("&#39;", "'")
    advice = {message.advice for message in MESSAGES.values() if message.advice}
    assert any(one in text for one in advice)


def test_the_run_shows_slices_and_the_command_does_with_the_stacks(
    finished: Path, planted_stacks: list[Path], text: str, tmp_path: Path
) -> None:
    n_slices = len((finished / "slices.tsv").read_text().splitlines()) - 1
    triples = text.count('<div class="triple">')
    assert triples == min(n_slices, 12)
    alone, with_stacks = tmp_path / "alone.html", tmp_path / "with.html"
    assert main([str(finished), "--output", str(alone)]) == 0
    assert alone.read_text().count('<div class="triple">') == 0
    assert "--stacks FILE" in alone.read_text()
    assert main([str(finished), "--output", str(with_stacks), "--stacks", *map(str, planted_stacks)]) == 0
    assert with_stacks.read_text().count('<div class="triple">') == triples


def test_names_from_files_are_text_and_no_markup(finished: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(finished, tmp_path / "run")
    path = folder / "run.json"
    evil = "</script><script>alert(1)</script>.nii"
    record = json.loads(path.read_text())
    record["stacks"][0]["name"] = evil
    record["warnings"].append(evil)
    path.write_text(json.dumps(record))
    assert evil not in report_html(folder)
    assert "&lt;/script&gt;" in report_html(folder)


def test_a_name_that_is_no_text_is_escaped(finished: Path, tmp_path: Path) -> None:
    """Files of other systems have such names; json holds them, a page in UTF-8 cannot."""
    folder = shutil.copytree(finished, tmp_path / "run")
    record = json.loads((folder / "run.json").read_text())
    record["stacks"][0]["name"] = "kopf-\udce4.nii"
    (folder / "run.json").write_text(json.dumps(record))
    (folder / "report.html").unlink()
    assert "kopf-\\udce4.nii" in page.write_report(folder).read_text(encoding="utf-8")


def test_a_report_that_fails_costs_no_volume(
    planted_stacks: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(*_: object) -> None:
        raise InputError("no room for it")

    monkeypatch.setattr(page, "write_report", fails)
    masks = [path.with_name(path.name.replace("stack", "mask")) for path in planted_stacks]
    line = ["--stacks", *planted_stacks, "--masks", *masks, "--preset", "fast", "--no-prior", "--resolution", "3"]
    assert infer.main([*map(str, line), "--threads", "1", "--quiet", "--output", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "volume.nii.gz").is_file()
    assert not (tmp_path / "out" / "report.html").exists()
    assert "report.html could not be written (no room for it)" in caplog.text


BAD = {
    "no folder": (lambda folder: shutil.rmtree(folder), "is no folder"),
    "no volume": (lambda folder: (folder / "volume.nii.gz").unlink(), "volume.nii.gz"),
    "no table": (lambda folder: (folder / "slices.tsv").unlink(), "slices.tsv: cannot be read"),
    "other table": (lambda folder: (folder / "slices.tsv").write_text("a\tb\n1\t2\n"), "is not a table"),
    "no record": (lambda folder: (folder / "run.json").write_text("{}"), "is not a run.json of this version"),
    "there already": (lambda folder: (folder / "report.html").write_text("mine"), "exists already; pass --force"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_folders_are_refused_in_one_line(
    name: str, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(finished, tmp_path / "run")
    (folder / "report.html").unlink()
    spoil, words = BAD[name]
    spoil(folder)
    before = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
    assert main([str(folder)]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("g3r-report: ")
    assert words in line
    assert (sorted(path.name for path in folder.iterdir()) if folder.exists() else []) == before
