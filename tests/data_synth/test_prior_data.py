"""Training data of the prior network: batches, epochs, settings."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("lightning")
pytest.importorskip("torchio")

from data_synth.prior_data import StackSynthesisDataModule
from data_synth.prior_samples import IMAGE_KEYS, SyntheticSubjects
from g3r.errors import InputError

TINY: dict[str, Any] = {
    "spacing_mm": 2.0,
    "patch_size": 24,
    "patches_per_subject": 4,
    "batch_size": 2,
    "subjects_per_epoch": 2,
    "val_subjects": 2,
    "val_crop": 40,
    "template_spacing_mm": 3.0,
}


def test_batches_of_training_and_validation() -> None:
    data = StackSynthesisDataModule(**TINY)
    loader = data.train_dataloader()
    assert len(loader) == 4
    batches = list(loader)
    assert len(batches) == 4
    for batch in batches:
        assert type(batch) is dict
        assert list(batch) == [*IMAGE_KEYS, "n_stacks", "thickness_mm"]
        assert batch["n_stacks"].shape == (2,)
        assert 1 <= int(batch["n_stacks"].min()) <= int(batch["n_stacks"].max()) <= 6
        for value in (batch[key] for key in IMAGE_KEYS):
            assert value.shape == (2, 1, 24, 24, 24)
            assert value.dtype == torch.float32
            assert bool(value.isfinite().all())
        assert set(batch["mask"].unique().tolist()) <= {0.0, 1.0}
        assert float(batch["truth"][batch["mask"] == 0].abs().max()) == 0
        assert float(batch["density"].min()) >= 0
        assert float(batch["coarse"].max()) < 3
        assert bool((batch["mask"].sum((1, 2, 3, 4)) > 100).all())
    second_epoch = next(iter(loader))
    assert not torch.equal(second_epoch["truth"], batches[0]["truth"])

    assert len(data.val_dataloader()) == 2
    first, again = next(iter(data.val_dataloader())), next(iter(data.val_dataloader()))
    assert first["coarse"].shape == (1, 1, 40, 40, 40)
    for key in first:
        torch.testing.assert_close(first[key], again[key], rtol=0, atol=0)


def test_what_remains_of_an_epoch_is_left_out() -> None:
    data = StackSynthesisDataModule(**{**TINY, "patches_per_subject": 5, "subjects_per_epoch": 1})
    loader = data.train_dataloader()
    assert len(loader) == 2
    first = [batch["truth"] for batch in loader]
    assert [len(truth) for truth in first] == [2, 2]
    again = [batch["truth"] for batch in data.train_dataloader()]  # a new loader begins at the first epoch
    torch.testing.assert_close(torch.cat(first), torch.cat(again), rtol=0, atol=0)


def test_training_on_a_folder(atlas: Path) -> None:
    data = StackSynthesisDataModule(source=str(atlas), include=["a/*"], val_include=["b/*"], **TINY)
    data.setup()
    assert data.train_set is not None
    assert data.val_set is not None
    assert [s.name for s in data.train_set.subjects] == ["a/week24", "a/week30"]
    assert [s.name for s in data.val_set.subjects] == ["b/ga-27"]
    assert len(next(iter(data.val_dataloader()))) == len(IMAGE_KEYS) + 2
    mixed = StackSynthesisDataModule(source=str(atlas), val_include=["week24"], phantom_share=0.5, **TINY)
    mixed.setup()
    assert mixed.train_set is not None
    assert len(mixed.train_set.subjects) == 4


def seeds_of(subjects: SyntheticSubjects, epoch: int, index: int) -> tuple[int, ...]:
    """Seeds of all random draws of an item."""
    seeds = subjects.draw(epoch, index)[1].bit_generator.seed_seq.entropy  # type: ignore[attr-defined]
    return tuple(seeds)


@pytest.mark.parametrize("source", ["phantom", "atlas"])
def test_training_and_validation_share_neither_subjects_nor_draws(source: str, atlas: Path) -> None:
    of_source: dict[str, Any] = (
        {} if source == "phantom" else {"source": str(atlas), "val_include": ["b/*"], "phantom_share": 0.5}
    )
    data = StackSynthesisDataModule(**TINY, **of_source, seed=3)
    train, val = data.make_sets()
    assert not {one.name for one in train.subjects} & {one.name for one in val.subjects}
    seeds = [{seeds_of(one, epoch, index) for epoch in range(3) for index in range(2)} for one in (train, val)]
    assert [len(one) for one in seeds] == [6, 6]
    assert not seeds[0] & seeds[1]


def test_the_template_is_made_of_the_training_subjects_once(atlas: Path) -> None:
    data = StackSynthesisDataModule(source=str(atlas), include=["a/*"], val_include=["b/*"], **TINY)
    template = data.template()
    assert data.template() is template
    assert template.weeks.tolist() == [22, 25, 28, 31]  # the ages within two weeks of 24 and 30
    np.testing.assert_allclose(template.grid.spacing_mm, 3.0)
    np.testing.assert_allclose(template.grid.center_mm, 0, atol=1e-6)


@pytest.mark.parametrize(
    "wrong",
    [
        {"patch_size": 0},
        {"phantom_share": 1.0},
        {"artefact_share": -0.1},
        {"batch_size": 99},
        {"source": "/no/such/folder"},
    ],
)
def test_bad_settings_say_so(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError, match=r"expected|raise"):
        StackSynthesisDataModule(**{**TINY, **wrong}).setup()


def test_validation_takes_one_two_and_three_stacks_in_turn() -> None:
    data = StackSynthesisDataModule(**{**TINY, "val_subjects": 3})
    assert [int(batch["n_stacks"]) for batch in data.val_dataloader()] == [1, 2, 3]


@pytest.mark.slow
def test_a_worker_process_makes_the_same_batches() -> None:
    batches = []
    for n_workers in (0, 1):
        loader = StackSynthesisDataModule(num_workers=n_workers, **TINY).train_dataloader()
        batches.append(torch.cat([batch["truth"] for _ in range(2) for batch in loader]))
    torch.testing.assert_close(batches[0], batches[1], rtol=1e-5, atol=1e-5)
