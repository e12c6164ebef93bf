"""Validation scores: over the brain, by confidence, and by place."""

import numpy as np
import pytest
import torch

from g3r.evaluation.metrics import score
from g3r.training.prior_validation import (
    RIM_MM,
    ValidationScores,
    confidence_bins,
    l1_by_confidence,
    psnr_by_place,
    sample_scores,
)
from tests.training.small_volumes import sample


def test_errors_by_confidence_are_of_the_brain_alone() -> None:
    density = torch.tensor([0.0, 0.2, 0.5, 3.0, 3.0]).reshape(1, 1, 1, 1, 5)
    mask = torch.tensor([1.0, 1, 1, 1, 0]).reshape(density.shape)
    error = torch.tensor([0.1, 0.2, 0.3, 0.4, 9.0]).reshape(density.shape)
    batch = {"density": density, "mask": mask, "truth": 0 * mask}
    found = {name: float(value) for name, value in l1_by_confidence(error, batch).items()}
    assert found == pytest.approx({"unseen": 0.1, "hardly_seen": 0.2, "thinly_seen": 0.3, "seen": 0.4})
    assert bool((torch.stack(confidence_bins(density)).sum(0) == 1).all())
    seen = {**batch, "density": density + 3}
    assert l1_by_confidence(error, seen).keys() == {"seen"}


@pytest.mark.parametrize("voxel_mm", [0.8, 1.2])
def test_validation_tells_rim_from_depth_and_seen_from_unseen(voxel_mm: float) -> None:
    """The error is 0.1 in the rim and 0.01 inside; the upper half is unseen."""
    mask = torch.zeros(1, 1, 24, 24, 24)
    mask[:, :, 2:22, 2:22, 2:22] = 1
    deep = torch.zeros_like(mask)
    n_rim = int(RIM_MM / voxel_mm)
    deep[:, :, 2 + n_rim : 22 - n_rim, 2 + n_rim : 22 - n_rim, 2 + n_rim : 22 - n_rim] = 1
    density = torch.full_like(mask, 3.0)
    density[..., 12:] = 0
    truth = torch.rand(mask.shape)
    made = truth + 0.1 + deep * (0.01 - 0.1)
    volumes = dict.fromkeys(("prior", "sharp", "coarse", "template"), made)
    scores = ValidationScores(voxel_mm)
    scores.add(volumes, {"truth": truth, "mask": mask, "density": density}, mask)
    found = psnr_by_place(scores.squares)
    assert found["psnr_prior_unseen_rim"] == pytest.approx(20, abs=0.01)
    assert found["psnr_template_seen_rim"] == pytest.approx(20, abs=0.01)
    assert found["psnr_prior_unseen_deep"] == pytest.approx(40, abs=0.01)
    assert not any("thinly" in name for name in found)
    n = scores.squares[..., 0, 1]
    assert float(n.sum()) == float(mask.sum())
    assert float(n[0].sum()) == float(mask[..., 12:].sum())


def test_validation_scores_are_those_of_an_evaluation() -> None:
    truth = sample(3, size=24)["truth"]
    mask = torch.zeros_like(truth)
    mask[:, 4:20, 5:21, 6:18] = 1
    torch.manual_seed(0)
    made = 0.8 * truth + 0.05 * torch.randn(truth.shape)
    found = sample_scores(made, truth, mask, weight=mask)
    expected = score(made[0].numpy(), truth[0].numpy(), mask[0].numpy() > 0)
    assert (found["psnr"], found["ssim"]) == (expected.psnr_db, expected.ssim)
    assert found["l1"] == pytest.approx(float((made - truth).abs()[mask > 0].mean()), rel=1e-5)


def test_a_sample_without_a_brain_has_no_psnr_and_a_diverged_one_has_nan() -> None:
    truth = sample(3)["truth"]
    assert sample_scores(truth, truth, torch.zeros_like(truth), torch.ones_like(truth)).keys() == {"l1"}
    found = sample_scores(torch.full_like(truth, torch.nan), truth, torch.ones_like(truth), torch.ones_like(truth))
    assert all(np.isnan(value) for value in found.values())
    assert found.keys() == {"l1", "psnr", "ssim"}
