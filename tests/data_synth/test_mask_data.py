"""Batches for the mask network, and reproducibility of every sample."""

from __future__ import annotations

import numpy as np
import pytest

from data_synth.atlas import TruthVolume

pytest.importorskip("lightning")
pytest.importorskip("torchio")

from data_synth.heads import PhantomSubject
from data_synth.mask_data import MaskDataModule, MaskSamples
from data_synth.mask_head import filled_head

SHAPES = {"wide_mm": 4.0, "wide_shape": (64, 64, 40), "pixel_mm": 2.4, "crop_shape": (48, 48, 4)}


def samples(head: TruthVolume, in_order: bool = False) -> MaskSamples:
    made = MaskSamples([PhantomSubject("a", 28.0, 3)], length=10, seed=7, n_scenes=2, in_order=in_order, **SHAPES)
    made._volumes = {0: filled_head(head)}
    return made


def test_items_are_functions_of_seed_and_number(centred_head: TruthVolume) -> None:
    first, second = samples(centred_head), samples(centred_head)
    np.testing.assert_array_equal(first[13].image, second[13].image)
    assert not np.array_equal(first[13].image, first[15].image)  # another scan of the same scene
    assert len(first._scenes) == 1


def test_scenes_of_another_epoch_are_forgotten(centred_head: TruthVolume) -> None:
    made = samples(centred_head)
    _ = made[0], made[11]
    assert set(made._scenes) == {(1, 1)}


def test_every_fifth_validation_scan_has_no_head(centred_head: TruthVolume) -> None:
    made = samples(centred_head, in_order=True)
    assert (made[4].mask > 0.5).mean() < 0.01
    assert made[3].wide_mask.max() > 0.5


def test_training_batches_stack_images_and_masks_of_two_samples(centred_head: TruthVolume) -> None:
    data = MaskDataModule(
        wide_shape=(48, 48, 4), crop_shape=(48, 48, 4), samples_per_epoch=4, batch_size=2, val_samples=1
    )
    data.setup()
    for one in (data.train_set, data.val_set):
        assert one is not None
        one._volumes = dict.fromkeys(range(len(one.subjects)), filled_head(centred_head))
    batch = next(iter(data.train_dataloader()))
    assert batch["wide_image"].shape == batch["wide_mask"].shape == (2, 1, 48, 48, 4)
    assert batch["image"].shape == batch["mask"].shape == (2, 1, 48, 48, 4)
    assert len(data.val_dataloader()) == 1
