"""Heads that several test modules share."""

from __future__ import annotations

from pathlib import Path

import pytest

from data_synth.atlas import TruthVolume
from data_synth.heads import PhantomSubject, load_head, load_volume_of
from tests.data_synth.atlas_files import write_subject

HEAD_SPACING_MM = 1.6


@pytest.fixture(scope="session")
def head() -> TruthVolume:
    """A labelled phantom of 30 weeks."""
    return load_volume_of(PhantomSubject("30w", 30.0, 3), HEAD_SPACING_MM)


@pytest.fixture(scope="session")
def centred_head() -> TruthVolume:
    """A phantom of 28 weeks in the atlas frame."""
    return load_head(PhantomSubject("28w", 28.0, 3), 2.0)


@pytest.fixture(scope="session")
def atlas(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with three subjects, in both naming schemes."""
    root = tmp_path_factory.mktemp("atlas")
    write_subject(root / "a" / "week24", 24)
    write_subject(root / "a" / "week30", 30, affine_flip=True)
    write_subject(root / "b", 27, names=("ga-27", "ga-27_mask"))
    (root / "b" / "notes.txt").write_text("not an image")
    return root
