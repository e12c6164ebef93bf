"""Cached subjects: only complete ones of the current version are used."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from data_synth import subject_cache
from data_synth.subject_cache import SubjectCache, SyntheticSubject

SCALARS = {"n_stacks": 3, "thickness_mm": 2.5}


def small_subject() -> SyntheticSubject:
    images = {
        field.name: np.full((3, 4, 5), 0.5, np.float32) for field in fields(SyntheticSubject) if field.name != "mask"
    }
    return SyntheticSubject(**{**images, "mask": np.ones((3, 4, 5), bool), **SCALARS})  # type: ignore[arg-type]


def test_a_kept_subject_comes_back(tmp_path: Path) -> None:
    SubjectCache(tmp_path, "spec").save(2, 1, small_subject())
    found = SubjectCache(tmp_path, "spec").load(2, 1)
    assert found is not None
    np.testing.assert_array_equal(found.truth, small_subject().truth)
    assert (found.n_stacks, found.thickness_mm) == (3, 2.5)
    assert SubjectCache(tmp_path, "spec").load(2, 0) is None
    assert SubjectCache(tmp_path, "other").load(2, 1) is None


@pytest.mark.parametrize("version", ["SYNTHESIS_VERSION", "SIMULATOR_VERSION"])
def test_subjects_of_another_version_are_not_taken(
    version: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    SubjectCache(tmp_path, "spec").save(0, 0, small_subject())
    monkeypatch.setattr(subject_cache, version, getattr(subject_cache, version) + 1)
    assert SubjectCache(tmp_path, "spec").load(0, 0) is None


def test_a_file_without_one_of_the_fields_is_stale(tmp_path: Path) -> None:
    cache = SubjectCache(tmp_path, "spec")
    cache.save(0, 0, small_subject())
    (path,) = tmp_path.iterdir()
    with np.load(path) as file:
        kept = {name: file[name] for name in file.files if name != "outline"}
    np.savez(path, **kept)
    assert cache.load(0, 0) is None
