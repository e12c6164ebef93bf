"""Parsing of BIDS file names."""

from __future__ import annotations

from pathlib import Path

import pytest

from g3r.bids.names import parsed_name


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("sub-01_ses-2_acq-haste_run-1_T2w.nii.gz", ("T2w",)),
        ("sub-01_T2w.nii", ("T2w",)),
        ("sub-01_run-1_T2w_desc-brain_mask.nii.gz", ("T2w", "mask")),
    ],
)
def test_names_of_bids(name: str, words: tuple[str, ...]) -> None:
    found = parsed_name(Path("anywhere") / name)
    assert found is not None
    assert found.words == words
    assert found.entities["sub"] == "01"


@pytest.mark.parametrize(
    "name", ["stack.nii.gz", "sub-01.nii.gz", "sub-01_T2w.json", "run-1_T2w.nii.gz", "sub-01_T2w_run-1.nii.gz",
             "sub-01_run-1_run-2_T2w.nii.gz"]
)  # fmt: skip
def test_other_names(name: str) -> None:
    assert parsed_name(Path(name)) is None


def test_a_scan_is_the_same_under_any_number_of_zeros() -> None:
    names = [parsed_name(Path(f"sub-01_{rest}.nii.gz")) for rest in ("run-01_T2w", "run-1_desc-brain_mask")]
    first, second = (name.scan for name in names if name)
    assert first == second
    other = parsed_name(Path("sub-01_run-10_T2w.nii.gz"))
    assert other
    assert other.scan != first
