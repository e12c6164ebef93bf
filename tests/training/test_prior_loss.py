"""The loss of the prior's training, and the random symmetries of its batches."""

import numpy as np
import pytest
import torch

from g3r.prior.config import PriorNetworkConfig
from g3r.prior.dgpn import PriorOutput
from g3r.training import prior_batches as batches
from tests.training.small_volumes import sample


def test_loss_weight_is_that_of_brain_band_and_background() -> None:
    """The weight is 1 in the brain, more in unseen parts, small outside, and larger next to the brain."""
    mask = torch.zeros(1, 1, 21, 21, 21)
    mask[0, 0, 10, 10, 9:11] = 1
    density = torch.full_like(mask, 50.0)
    density[0, 0, 10, 10, 9] = 0
    weight = batches.loss_weight({"mask": mask, "density": density}, 0.02)
    assert float(weight[0, 0, 10, 10, 10]) == pytest.approx(1)
    assert float(weight[0, 0, 10, 10, 9]) == pytest.approx(1 + batches.UNSEEN_EMPHASIS)
    band = 0.02 * batches.BAND_FACTOR
    assert float(weight[0, 0, 10, 10, 10 + batches.BAND_VOXELS]) == pytest.approx(band)
    assert float(weight[0, 0, 10, 10, 11 + batches.BAND_VOXELS]) == pytest.approx(0.02)
    wide = 2 * batches.BAND_VOXELS + 1
    n_band = wide * wide * (wide + 1) - 2
    expected = 2 + batches.UNSEEN_EMPHASIS + band * n_band + 0.02 * (21**3 - n_band - 2)
    assert float(weight.sum()) == pytest.approx(expected, rel=1e-5)
    # never more than the brain's
    assert float(batches.loss_weight({"mask": mask, "density": density}, 1.0).min()) == 1


def test_the_loss_wants_the_median_where_slices_looked_and_the_mean_where_none_did() -> None:
    """For a voxel that is 0 in three heads and 1 in one, the loss is least at 0 if seen, and at 1/4 if unseen."""
    truth = torch.tensor([0.0, 0, 0, 1]).reshape(4, 1, 1, 1, 1)
    mask = torch.ones_like(truth)
    guesses = torch.linspace(0, 1, 101)
    for density, best in ((30.0, 0.0), (0.0, 0.25)):
        batch = {"truth": truth, "mask": mask, "density": torch.full_like(truth, density)}
        losses = [
            float(batches.prior_loss(PriorOutput(torch.full_like(truth, float(x)), 9 * mask), batch, mask))
            for x in guesses
        ]
        assert float(guesses[int(np.argmin(losses))]) == pytest.approx(best, abs=0.011)


def test_the_loss_asks_for_the_brain_above_all_where_no_slice_looked() -> None:
    truth = torch.zeros(1, 1, 1, 1, 2)
    mask = torch.tensor([1.0, 0.0]).reshape(truth.shape)

    def loss(logit: torch.Tensor, density: float) -> float:
        batch = {"truth": truth, "mask": mask, "density": torch.full_like(truth, density)}
        return float(batches.prior_loss(PriorOutput(truth, logit), batch, torch.ones_like(truth)))

    right, undecided = 12 * (mask - 0.5), 0 * mask
    assert loss(right, 0.0) < 0.01 * loss(undecided, 0.0)
    assert loss(undecided, 0.0) == pytest.approx(batches.BRAIN_FACTOR * np.log(2), rel=1e-5)
    # the unseen voxel counts more than the seen one
    batch = {"truth": truth, "mask": 0 * mask, "density": torch.tensor([30.0, 0.0]).reshape(truth.shape)}
    seen_wrong, unseen_wrong = (
        float(batches.prior_loss(PriorOutput(truth, 12 * (wrong - 0.5)), batch, torch.ones_like(truth)))
        for wrong in (mask, 1 - mask)
    )
    assert unseen_wrong > 5 * seen_wrong


def test_weighted_l1_of_an_empty_mask_without_background_is_zero() -> None:
    ones = torch.ones(1, 1, 4, 4, 4)
    assert float(batches.weighted_l1(ones, 0 * ones, 0 * ones)) == 0.0


def test_symmetries_turn_all_volumes_alike() -> None:
    batch = {name: value[None] for name, value in sample(0, size=8).items()}
    batch["density"] = batch["truth"].clone()
    seen = set()
    for seed in range(200):
        torch.manual_seed(seed)
        turned = batches.random_cube_symmetry(batch)
        assert torch.equal(turned["density"], turned["truth"])
        seen.add(turned["truth"].numpy().tobytes())
    assert 40 < len(seen) <= 48


def test_symmetries_keep_the_shape() -> None:
    batch = {"truth": torch.rand(1, 1, 4, 4, 6)}
    assert {tuple(batches.random_cube_symmetry(batch)["truth"].shape) for _ in range(20)} == {(1, 1, 4, 4, 6)}


def test_kinds_of_density_change_what_f_and_gate_read_and_nothing_else() -> None:
    batch = {name: value[None] for name, value in sample(0).items()} | {"thickness_mm": torch.tensor([2.5])}
    config = PriorNetworkConfig()
    given = {kind: batches.prior_inputs(batch, kind) for kind in batches.DENSITY_KINDS}
    read = {
        "coverage": batch["density"],
        "masked": batch["density"] * batch["share"],
        "printed": batch["density"] / 2.5,
    }
    of_brain = {**read, "coverage": read["masked"], "printed": read["masked"] / 2.5}
    for kind, one in given.items():
        torch.testing.assert_close(one.read_density, read[kind])
        shown = one.shown(config)
        torch.testing.assert_close(shown[1], -torch.expm1(-of_brain[kind]))
        torch.testing.assert_close(shown[3], -torch.expm1(-read[kind]))
        assert torch.equal(one.base(config), given["coverage"].base(config))
        assert torch.equal(one.base_logit(config), given["coverage"].base_logit(config))
