"""Training subjects: ages by name, and no overlap of training and validation."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pytest

from data_synth.atlas import AtlasSubject, find_subjects
from data_synth.heads import N_PHANTOMS, PhantomSubject, Subject, training_and_validation, weeks_of
from g3r.errors import InputError


def of_atlas(name: str) -> AtlasSubject:
    return AtlasSubject(name, Path("t2.nii.gz"), Path("mask.nii.gz"))


def names(subjects: Sequence[Subject]) -> list[str]:
    return [one.name for one in subjects]


@pytest.mark.parametrize(
    ("name", "weeks"),
    [
        ("crl/sta27", 27),
        ("STA21", 21),
        ("sb/sb23-notoperated", 23),
        ("x/ga-31.5_v2", 31.5),
        ("atlas_GA25_operated", 25),
        ("week27", 27),
        ("weeks-27", 27),
        ("sub-020_27w", 27),
        ("case31/28.5-weeks", 28.5),
        ("week2_ga29", 29),
    ],
)
def test_age_from_the_name(name: str, weeks: float) -> None:
    assert weeks_of(of_atlas(name)) == weeks


@pytest.mark.parametrize(
    "name", ["sub-020", "case31", "atlas/subject-7", "week27/sub-30", "27wide", "sta7", "ga-60", "usb23", "27", "week"]
)
def test_a_number_alone_is_no_age(name: str) -> None:
    with pytest.raises(InputError, match=r"^t2\.nii\.gz: no gestational age.*between 15 and 45 as in sta27.*rename"):
        weeks_of(of_atlas(name))
    assert weeks_of(of_atlas(name), 30.0) == 30.0


def test_a_phantom_has_its_own_age() -> None:
    assert weeks_of(PhantomSubject("sta27", 33.0, 1)) == 33


def test_ages_of_the_atlases_that_the_weights_were_made_from(shared_data: Path) -> None:
    found = {one.name: weeks_of(one) for one in find_subjects(shared_data / "atlas")}
    assert len(found) > 30
    for name, weeks in found.items():
        (number,) = re.findall(r"\d+", name)
        assert weeks == float(number), name


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_training_and_validation_share_no_phantom(seed: int) -> None:
    train, val = training_and_validation("phantom", None, None, None, n_val_phantoms=6, seed=seed)
    assert (len(train), len(val)) == (N_PHANTOMS, 6)
    assert not set(names(train)) & set(names(val))
    seeds = [{one.seed for one in side if isinstance(one, PhantomSubject)} for side in (train, val)]
    assert [len(one) for one in seeds] == [N_PHANTOMS, 6]
    assert not seeds[0] & seeds[1]


def split(atlas: Path, exclude: list[str] | None, val_include: list[str] | None) -> tuple[list[str], list[str]]:
    train, val = training_and_validation(str(atlas), None, exclude, val_include, n_val_phantoms=2, seed=0)
    return names(train), names(val)


def test_subjects_to_validate_on_are_not_trained_on(atlas: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert split(atlas, None, ["ga-*"]) == (["a/week24", "a/week30"], ["b/ga-27"])
    assert split(atlas, None, ["a/*"]) == (["b/ga-27"], ["a/week24", "a/week30"])
    assert caplog.records == []


def test_excluded_subjects_are_on_neither_side(atlas: Path) -> None:
    assert split(atlas, ["week30"], ["week*"]) == (["b/ga-27"], ["a/week24"])
    with pytest.raises(InputError, match=r"none of 3 subjects.*change the patterns"):
        split(atlas, ["week30"], ["week30"])


def test_validating_on_the_training_subjects_is_said(atlas: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert split(atlas, ["week30"], None) == (["a/week24", "b/ga-27"],) * 2
    assert [record.getMessage() for record in caplog.records] == [
        "no val_include given: validating on other simulations of the training subjects"
    ]
