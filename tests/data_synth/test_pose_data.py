"""Batches of slice sets, and reproducibility of every set."""

import numpy as np
import pytest

from data_synth.atlas import TruthVolume

pytest.importorskip("lightning")
pytest.importorskip("torchio")

from data_synth.heads import PhantomSubject
from data_synth.pose_data import SliceSetDataModule, SliceSets


def test_items_are_functions_of_seed_and_number() -> None:
    subjects = [PhantomSubject("a", 28.0, 3)]
    first, second = (SliceSets(subjects, length=4, seed=7, max_slices=12, pixel_mm=3.0, size=40) for _ in range(2))
    np.testing.assert_array_equal(first[5].images.image, second[5].images.image)
    assert first[5].images.image.shape != first[6].images.image.shape or not np.array_equal(
        first[5].images.image, first[6].images.image
    )


def test_batches_number_stacks_by_set_and_validation_has_one_to_six_stacks(centred_head: TruthVolume) -> None:
    data = SliceSetDataModule(source="phantom", sets_per_epoch=3, batch_size=3, max_slices=12, val_sets=6)
    data.setup()
    for sets in (data.train_set, data.val_set):
        assert sets is not None
        sets._volumes = dict.fromkeys(range(len(sets.subjects)), centred_head)
    batch = next(iter(data.train_dataloader()))
    n = len(batch["image"])
    assert batch["image"].shape == (n, 1, 40, 40)
    assert batch["set_of_stack"].max() == 2
    assert (batch["set_of_stack"][batch["stack"]].diff() >= 0).all()
    assert sorted(len(b["set_of_stack"]) for b in data.val_dataloader()) == [1, 2, 3, 4, 5, 6]
