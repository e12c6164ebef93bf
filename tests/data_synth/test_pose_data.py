"""Batches of slice sets, and reproducibility of every set."""

import numpy as np
import pytest

from data_synth.atlas import TruthVolume

pytest.importorskip("lightning")
pytest.importorskip("torchio")

from data_synth.heads import PhantomSubject
from data_synth.pose_data import SliceSetDataModule, SliceSets, slice_set_batch
from g3r.pose_network.inference import slice_batch


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


def test_training_and_inference_make_the_same_batch_of_images() -> None:
    made = SliceSets([PhantomSubject("a", 28.0, 3)], length=2, seed=7, max_slices=12, pixel_mm=3.0, size=40)
    sets = [made[0], made[1]]
    training, inference = slice_set_batch(sets), slice_batch([one.images for one in sets])
    assert set(training) - set(inference) == {"true_rotation", "true_translation_mm"}
    for name, value in inference.items():
        np.testing.assert_array_equal(training[name], value)
    true = np.concatenate([one.true_pose.rotation for one in sets])
    np.testing.assert_array_equal(training["true_rotation"], true.astype(np.float32))
    assert inference["set_of_stack"].tolist() == sorted(inference["set_of_stack"].tolist())
    assert len(inference["set_of_stack"]) == int(inference["stack"].max()) + 1
