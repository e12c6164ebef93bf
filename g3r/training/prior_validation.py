"""Validation of the prior's training: scores of every volume, by number of stacks, and a row of images."""

import math
from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from g3r.evaluation.metrics import score
from g3r.prior.gate import DensityGate, confidence_from_density
from g3r.training.prior_batches import Batch, weighted_l1

VALIDATED = ("prior", "sharp", "coarse", "template")
"""Volumes that are scored: the network's, and those it starts from."""
METRICS = ("l1", "psnr", "ssim")
MAX_STACKS = 12
"""Larger numbers of stacks are counted as this many."""
PANEL_TAG = "coarse, sharp, template, confidence, gate, prior, truth, 4 x error"

CONFIDENCE_BINS = {"unseen": 0.05, "hardly_seen": 0.3, "thinly_seen": 0.6, "seen": np.inf}
"""Bins of the confidence c by name, with their upper ends."""
RIM_MM = 3.0
PLACES = ("rim", "deep")
"""The outermost `RIM_MM` of the brain, and the rest."""


class ValidationScores:
    """Sums and counts of the scores of one epoch; row 0 is over all volumes, row n over those of n stacks.

    Args:
        voxel_mm: voxel size of the volumes.
    """

    def __init__(self, voxel_mm: float) -> None:
        self.voxel_mm = voxel_mm
        self.sums = torch.zeros(MAX_STACKS + 1, len(VALIDATED), len(METRICS), 2, dtype=torch.float64)
        self.squares = torch.zeros(len(CONFIDENCE_BINS), len(PLACES), len(VALIDATED), 2, dtype=torch.float64)

    def add(self, volumes: Mapping[str, Tensor], batch: Batch, weight: Tensor) -> None:
        """Score every sample of a batch.

        Args:
            volumes: [B, 1, I, J, K] for each name in `VALIDATED`.
            batch: the batch that they were made from.
            weight: weight of the L1 error, [B, 1, I, J, K].
        """
        for b, n in enumerate(stack_numbers(batch)):
            for v, name in enumerate(VALIDATED):
                found = sample_scores(volumes[name][b], batch["truth"][b], batch["mask"][b], weight[b])
                for m, metric in enumerate(METRICS):
                    if metric in found:
                        for row in {0, n}:
                            self.sums[row, v, m] += torch.tensor([found[metric], 1.0], dtype=torch.float64)
                squared = (volumes[name][b, 0] - batch["truth"][b, 0]).double().cpu() ** 2
                for k, bins in enumerate(confidence_bins(batch["density"][b, 0].cpu())):
                    for p, place in enumerate(_places(batch["mask"][b, 0], self.voxel_mm)):
                        chosen = squared[bins & place]
                        self.squares[k, p, v] += torch.tensor([float(chosen.sum()), len(chosen)], dtype=torch.float64)


def confidence_bins(density: Tensor) -> list[Tensor]:
    """Masks of the voxels in each of `CONFIDENCE_BINS`, of the density's shape."""
    c = confidence_from_density(density)
    ends = [-np.inf, *CONFIDENCE_BINS.values()]
    return [(c >= low) & (c < high) for low, high in pairwise(ends)]


def l1_by_confidence(volume: Tensor, batch: Batch) -> dict[str, Tensor]:
    """Mean absolute error of a batch's brain in each of `CONFIDENCE_BINS` that has voxels."""
    error, brain = (volume - batch["truth"]).abs(), batch["mask"] > 0.5
    chosen = {name: bins & brain for name, bins in zip(CONFIDENCE_BINS, confidence_bins(batch["density"]), strict=True)}
    return {name: error[one].mean() for name, one in chosen.items() if bool(one.any())}


def psnr_by_place(squares: Tensor) -> dict[str, float]:
    """PSNR (dB, of an intensity of 1) over all volumes by name: `psnr_prior_unseen_deep` and so on.

    Args:
        squares: [bins, places, volumes, 2], sums of squared errors and numbers of voxels.
    """
    found = {}
    for of_bin, bin_name in zip(squares.double().cpu(), CONFIDENCE_BINS, strict=True):
        for of_place, place in zip(of_bin, PLACES, strict=True):
            for (total, count), name in zip(of_place.tolist(), VALIDATED, strict=True):
                if count and total > 0:
                    found[f"psnr_{name}_{bin_name}_{place}"] = 10 * math.log10(count / total)
    return found


def _places(mask: Tensor, voxel_mm: float) -> list[Tensor]:
    """Masks of the rim and of the rest of a brain [I, J, K]."""
    inside = (mask > 0.5).cpu().numpy()
    depth = distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1, 1:-1] * voxel_mm
    return [torch.from_numpy(inside & (depth <= RIM_MM)), torch.from_numpy(inside & (depth > RIM_MM))]


def sample_scores(volume: Tensor, truth: Tensor, mask: Tensor, weight: Tensor) -> dict[str, float]:
    """Return weighted L1 of one sample, and PSNR (dB) and SSIM in the mask as `g3r-evaluate` defines them.

    PSNR and SSIM are absent if the mask is empty, and NaN if the volume is not finite.

    Args:
        volume: [1, I, J, K].
        truth: of the same shape.
        mask: brain, of the same shape.
        weight: weight of the L1 error, of the same shape.
    """
    found = {"l1": float(weighted_l1(volume, truth, weight))}
    inside = (mask[0] > 0.5).cpu().numpy()
    if inside.any():
        made, true = (one[0].float().cpu().numpy() for one in (volume, truth))
        finite = bool(np.isfinite(made[inside]).all())
        scores = score(made, true, inside) if finite else None
        found |= {"psnr": scores.psnr_db, "ssim": scores.ssim} if scores else {"psnr": np.nan, "ssim": np.nan}
    return found


def stack_numbers(batch: Batch) -> list[int]:
    """The number of stacks of each sample, at most `MAX_STACKS`; 0 if the batch does not state it."""
    if "n_stacks" not in batch:
        return [0] * len(batch["truth"])
    return [min(int(n), MAX_STACKS) for n in batch["n_stacks"]]


def stacks_suffix(n_stacks: int) -> str:
    """Ending of a tag: `_1stack`, `_3stacks`, or nothing for 0."""
    return f"_{n_stacks}stack{'s' * (n_stacks > 1)}" if n_stacks else ""


def validation_means(sums: Tensor) -> dict[str, float]:
    """Means by name: `psnr_prior`, `psnr_prior_1stack`, `psnr_gain` (prior less V_coarse) and so on.

    Args:
        sums: [`MAX_STACKS` + 1, volumes, metrics, 2], see `ValidationScores`.
    """
    result: dict[str, float] = {}
    for n, of_volume in enumerate(sums.double().cpu()):
        for name, of_metric in zip(VALIDATED, of_volume, strict=True):
            for metric, (total, count) in zip(METRICS, of_metric.tolist(), strict=True):
                if count:
                    result[f"{metric}_{name}{stacks_suffix(n)}"] = total / count
        prior, coarse = (result.get(f"psnr_{name}{stacks_suffix(n)}") for name in ("prior", "coarse"))
        if prior is not None and coarse is not None:
            result[f"psnr_gain{stacks_suffix(n)}"] = prior - coarse
    return result


def panel(batch: Batch, prior: Tensor, gate: DensityGate | None) -> Tensor:
    """Return the volumes named in `PANEL_TAG` side by side, [H, W] in [0, 1].

    The section is the one with the most brain of the batch's first sample. The error is 4 |prior - truth|.

    Args:
        batch: has at least one sample.
        prior: V_prior of the same samples, [B, 1, I, J, K].
        gate: None shows a gate of 1 everywhere.
    """
    volumes = {name: value[0, 0].detach().float().cpu() for name, value in batch.items() if value.ndim == 5}
    section = int((volumes["mask"] > 0.5).sum((0, 1)).argmax())
    truth, density, shown = volumes["truth"], volumes["density"], prior[0, 0].detach().float().cpu()
    row = [
        volumes["coarse"],
        volumes["sharp"],
        volumes["template"],
        confidence_from_density(density),
        torch.ones_like(density) if gate is None else gate(density),
        shown,
        truth,
        4.0 * (shown - truth).abs(),
    ]
    # columns follow i (to the patient's right), rows follow j upwards (to anterior)
    return torch.cat([image[:, :, section].T.flip(0) for image in row], 1).clamp(0.0, 1.0)
