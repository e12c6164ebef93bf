"""Texts of headers and names of folders do not appear in results unless requested."""

from __future__ import annotations

import binascii
import gzip
import json
import re
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from data_synth import cli as simulate
from g3r.acquisition.header_text import HeaderText, read_header_text
from g3r.acquisition.images import load_volume, save_volume
from g3r.cli.infer import main
from g3r.output.result import ReconstructionResult
from g3r.reconstruct import GaussianReconstructor
from tests.faults.nifti_files import AFFINE, ball, image, write_raw
from tests.tally import Tally

CANARY = "DOE^JANE 1987"
"""Word as short as the shortest text field, so that every field can hold it."""

WORDS = {
    "descrip": b"of DOE^JANE 1987 on 2026-11-21",
    "aux_file": b"/ DOE^JANE 1987",
    "intent_name": b"DOE^JANE 1987",
    "db_name": b"DOE^JANE 1987",
    "data_type": b"E^JANE 198",
}
EXTENSIONS = ((6, b"DOE^JANE 1987"), (2, b"\0\1DOE^JANE 1987\xff"), (4, b"<DOE^JANE 1987/>"), (44, b"DOE^JANE 1987"))


def planted(path: Path, data: np.ndarray) -> Path:
    """A file with a patient's name in every text field."""
    return write_raw(path, data, WORDS, extensions=EXTENSIONS)


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two stacks of a head-like object, in a folder with the patient's name."""
    folder = tmp_path_factory.mktemp("data") / CANARY
    folder.mkdir()
    for n in range(2):
        smooth = gaussian_filter(image(n), (2, 2, 1)) + 200 * gaussian_filter(ball().astype(np.float32), 1)
        planted(folder / f"stack-{n}.nii.gz", smooth)
        planted(folder / f"mask-{n}.nii.gz", ball())
    return folder


def line(subject: Path, output: Path) -> list[str]:
    files = [[str(subject / f"{kind}-{n}.nii.gz") for n in range(2)] for kind in ("stack", "mask")]
    return [
        "--stacks",
        *files[0],
        "--masks",
        *files[1],
        "--preset",
        "preview",
        "--no-prior",
        "--resolution",
        "3",
        "--threads",
        "1",
        "--quiet",
        "--output",
        str(output),
    ]


@pytest.fixture(scope="module")
def result(subject: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ReconstructionResult]:
    """The output folder of the command, and its terminal output."""
    kept: list[ReconstructionResult] = []
    work = GaussianReconstructor.reconstruct

    def reconstruct(self: GaussianReconstructor, *arguments: Any, **options: Any) -> ReconstructionResult:
        kept.append(work(self, *arguments, **options))
        return kept[0]

    folder = tmp_path_factory.mktemp("results") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(GaussianReconstructor, "reconstruct", reconstruct)
        assert main(line(subject, folder)) == 0
    return folder, kept[0]


BASE64 = re.compile(rb"[A-Za-z0-9+/]{200,}={0,2}")
"""Base64 text, which contains short words by chance; only the decoded bytes are searched."""


def texts_of(folder: Path) -> dict[str, bytes]:
    """All written files, uncompressed."""
    found = {}
    for path in folder.iterdir():
        found[path.name] = path.read_bytes()
        if path.name.endswith(".gz"):
            found[path.name + " unpacked"] = gzip.decompress(path.read_bytes())
        if path.name.endswith(".npz"):
            with zipfile.ZipFile(path) as archive:
                found |= {f"{path.name} {one}": archive.read(one) for one in archive.namelist()}
        if path.suffix == ".html":
            for n, letters in enumerate(BASE64.findall(path.read_bytes())):
                found[f"{path.name} unpacked {n}"] = binascii.a2b_base64(letters + b"==")
            found[path.name] = BASE64.sub(b"", found[path.name])
    return found


def traces(folder: Path) -> list[str]:
    """Files below a folder that contain a part of the canary or of a path."""
    folders = [str(folder.parent.parent).encode(), b"/tmp", b"pytest-of"]
    words = [b"DOE^", b"JANE", b"2026-11-21", *folders]
    return [name for name, content in texts_of(folder).items() if any(word in content for word in words)]


def test_the_inputs_do_hold_the_name(subject: Path) -> None:
    """The search can succeed: the name is in every text field of the stacks."""
    content = gzip.decompress((subject / "stack-0.nii.gz").read_bytes())
    assert content.count(CANARY.encode()) == len(WORDS) - 1 + len(EXTENSIONS)
    assert set(traces(subject)) >= {"stack-0.nii.gz unpacked", "mask-1.nii.gz unpacked"}


def test_nothing_of_it_is_in_the_results(result: tuple[Path, ReconstructionResult], tally: Tally) -> None:
    folder, _ = result
    with tally.case():
        assert traces(folder) == []
        header = nib.Nifti1Image.from_filename(folder / "volume.nii.gz").header
        assert all(not header[name].item() for name in WORDS)
        assert not header.extensions
        record = json.loads((folder / "run.json").read_text())
        assert record["command"]["stacks"] == ["stack-0.nii.gz", "stack-1.nii.gz"]  # names, no folders


def test_it_is_there_when_asked_for(
    subject: Path,
    result: tuple[Path, ReconstructionResult],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    tally: Tally,
) -> None:
    earlier = replace(result[1], record=replace(result[1].record))
    monkeypatch.setattr(GaussianReconstructor, "reconstruct", lambda *arguments, **options: earlier)
    with tally.case():
        assert main([*line(subject, tmp_path / "out"), "--keep-header-text"]) == 0
        images = sorted((tmp_path / "out").glob("*.nii.gz"))
        assert len(images) >= 6
        for path in images:
            text = read_header_text(path)
            assert text.fields == {name: value.decode() for name, value in WORDS.items()}
            assert text.extensions == EXTENSIONS
        np.testing.assert_array_equal(
            load_volume(tmp_path / "out" / "volume.nii.gz").data, load_volume(result[0] / "volume.nii.gz").data
        )
        record = json.loads((tmp_path / "out" / "run.json").read_text())
        assert [one["fields"]["descrip"] for one in record["header_text"]] == [WORDS["descrip"].decode()] * 2
        assert record["header_text"][0]["extensions"][1]["text"].endswith("DOE^JANE 1987\\xff")


def test_text_survives_a_round_trip_and_nothing_is_invented(tmp_path: Path, tally: Tally) -> None:
    with tally.case():
        text = HeaderText({"descrip": "a", "db_name": "\udcff é"}, ((6, b"one"), (6, b"two" * 99)))
        save_volume(tmp_path / "v.nii.gz", image(), AFFINE, text)
        assert read_header_text(tmp_path / "v.nii.gz") == text
        np.testing.assert_array_equal(load_volume(tmp_path / "v.nii.gz").data, image())
        save_volume(tmp_path / "w.nii.gz", image(), AFFINE)
        assert read_header_text(tmp_path / "w.nii.gz") == HeaderText()


def test_simulated_stacks_say_nothing_of_their_volume(subject: Path, tmp_path: Path, tally: Tally) -> None:
    volume = planted(subject / "volume.nii.gz", image(5, (20, 20, 12)))
    mask = planted(subject / "head.nii.gz", ball((20, 20, 12)))
    with tally.case():
        words = ["--volume", volume, "--mask", mask, "--stacks", 1, "--resolution", 2, "--output", tmp_path / "out"]
        assert simulate.main([str(word) for word in words]) == 0
        assert traces(tmp_path / "out") == []
