"""Stored networks: the shipped ones are loaded on first use, all others immediately."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from g3r.checkpoints.stored_model import StoredModel
from g3r.checkpoints.weights_file import WeightsFile
from g3r.errors import InputError
from g3r.pose_network.model import PoseModel
from g3r.pose_network.stored_template import stored_template
from g3r.prior.model import Prior
from tests.checkpoints.altered_files import small_prior


def test_what_ships_is_loaded_when_it_is_asked_for() -> None:
    loaded: list[WeightsFile] = []

    def load(file: WeightsFile) -> Prior:
        loaded.append(file)
        return Prior.load(file)

    stored = StoredModel(None, "prior", load)
    assert stored.ships
    assert loaded == []
    assert stored.model is stored.model
    assert loaded == [stored.file]


@pytest.mark.parametrize("name", [None, "cc0"])
def test_its_record_and_template_are_those_of_the_network(name: str | None) -> None:
    stored = StoredModel(name, "pose", PoseModel.load)
    model = PoseModel.load(name)
    assert stored.record() == {key: plain(value) for key, value in model.record().items()}
    template = stored_template(stored)
    np.testing.assert_array_equal(template.volume, model.template.volume)
    np.testing.assert_array_equal(template.affine, model.template.affine)
    assert template.weeks.tolist() == model.template.weeks.tolist()


def plain(value: object) -> object:
    """The record as JSON returns it, without tuples."""
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    return [plain(one) for one in value] if isinstance(value, list | tuple) else value


def test_another_file_is_loaded_at_once(tmp_path: Path) -> None:
    small_prior().save(tmp_path / "own.safetensors")
    assert not StoredModel(tmp_path / "own.safetensors", "prior", Prior.load).ships
    with pytest.raises(InputError, match="is not a pose checkpoint"):
        StoredModel(tmp_path / "own.safetensors", "pose", PoseModel.load)
    with pytest.raises(InputError, match="no such file"):
        StoredModel(tmp_path / "none.safetensors", "prior", Prior.load)
