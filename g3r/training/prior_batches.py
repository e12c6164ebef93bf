"""Batches of the prior's training: their form, their symmetries and their loss."""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn import functional

from g3r.prior.dgpn import PriorOutput
from g3r.prior.inputs import PriorInputs

Batch = Mapping[str, Tensor]
"""Volumes by `IMAGE_KEYS` of the data module, each float32 [B, 1, I, J, K], intensities "p99-coarse-v1".

`n_stacks`, int64 [B], is optional: with it, scores are also logged by the number of stacks. `thickness_mm`,
float32 [B], is needed for the printed density. Other entries are not changed."""

DENSITY_KINDS = ("coverage", "masked", "printed")
"""Definitions of M_rho for gate and F: Eq. 6 over whole slices, dimensionless; over masked pixels alone; or over whole
slices as printed, with the unit 1/mm."""

BAND_VOXELS = 5
"""Width of the band of background next to the brain, where the prior must fall off as the brain does."""
BAND_FACTOR = 5.0
"""Weight of the band relative to the background."""
UNSEEN_EMPHASIS = 2.0
"""Additional weight of a voxel without coverage, because there are few of them."""
SQUARED_FACTOR = 2.0
"""Factor of the squared error of unseen voxels; at an error of 0.5 it equals the absolute error of seen ones."""
BRAIN_FACTOR = 0.1
"""Weight of the brain's cross-entropy in the loss."""
SEEN_BRAIN_WEIGHT = 0.1
"""Weight of seen voxels, whose masks are known, in that cross-entropy, relative to unseen ones."""


def prior_inputs(batch: Batch, density: str = "coverage") -> PriorInputs:
    """The inputs of the network from a batch.

    Args:
        batch: see `Batch`.
        density: one of `DENSITY_KINDS`; only the first is for use, the others are for comparison.
    """
    maps = {name: batch[name] for name in ("coarse", "density", "share", "sharp", "template", "outline")}
    if density == "masked":
        return PriorInputs(**maps, gating=batch["density"] * batch["share"])
    if density == "printed":
        thickness_mm = batch["thickness_mm"].reshape(-1, 1, 1, 1, 1)
        return PriorInputs(**maps, gating=batch["density"] / thickness_mm, gating_share=batch["share"])
    return PriorInputs(**maps)


def loss_weight(batch: Batch, background_weight: float) -> Tensor:
    """Return the weight of each voxel's error, [B, 1, I, J, K].

    From 1 (seen) to 1 + `UNSEEN_EMPHASIS` (unseen) in the brain; `background_weight` outside, and
    `BAND_FACTOR` times that next to the brain.

    Args:
        batch: has `mask` and `density`.
        background_weight: 0 to 1.
    """
    brain = (batch["mask"] > 0.5).to(batch["mask"].dtype)
    band = _dilated(brain, BAND_VOXELS)
    outside = background_weight * (1 + (BAND_FACTOR - 1) * band)
    return torch.lerp(outside.clamp_max(1.0), 1 + UNSEEN_EMPHASIS * torch.exp(-batch["density"]), brain)


def _dilated(mask: Tensor, n_voxels: int) -> Tensor:
    """A mask [B, 1, I, J, K] dilated axis by axis, which takes a tenth of the time of a cubic kernel."""
    for axis in range(3):
        kernel, padding = [1, 1, 1], [0, 0, 0]
        kernel[axis], padding[axis] = 2 * n_voxels + 1, n_voxels
        mask = functional.max_pool3d(mask, kernel, stride=1, padding=padding)
    return mask


def prior_loss(found: PriorOutput, batch: Batch, weight: Tensor) -> Tensor:
    """Return the training loss of V_prior and the brain's logit, a scalar.

    The absolute error where slices looked (G3R Sec. 2.3) and the squared one where none did: there many brains are
    possible, and their mean is wanted, not their median. In addition the cross-entropy of brain and background.

    Args:
        found: output of the network.
        batch: the batch that it was made from.
        weight: from `loss_weight`.
    """
    unseen = torch.exp(-batch["density"])
    error = found.volume - batch["truth"]
    size = (1 - unseen) * error.abs() + SQUARED_FACTOR * unseen * error**2
    brain = (batch["mask"] > 0.5).to(found.brain_logit.dtype)
    entropy = functional.binary_cross_entropy_with_logits(found.brain_logit, brain, reduction="none")
    brain_weight = SEEN_BRAIN_WEIGHT + unseen
    return mean_by_weight(size, weight) + BRAIN_FACTOR * mean_by_weight(entropy, brain_weight)


def mean_by_weight(value: Tensor, weight: Tensor) -> Tensor:
    """Return sum(w v) / sum(w), a scalar.

    Args:
        value: v, any shape.
        weight: w >= 0, of the same shape.
    """
    return (weight * value).sum() / weight.sum().clamp_min(torch.finfo(weight.dtype).tiny)


def weighted_l1(volume: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """Return sum(w |V - truth|) / sum(w), a scalar.

    Args:
        volume: V, [B, 1, I, J, K].
        truth: [B, 1, I, J, K].
        weight: w >= 0, of the same shape.
    """
    return mean_by_weight((volume - truth).abs(), weight)


def random_cube_symmetry(batch: Batch) -> dict[str, Tensor]:
    """Return the batch mirrored and rotated by one random symmetry of its grid (48 of a cube).

    Axes are exchanged only among those of equal extent, so the shape stays the same. The random numbers are
    torch's global ones, which Lightning seeds.
    """
    shape = batch["truth"].shape[2:]
    order = torch.randperm(3).tolist()
    if [shape[axis] for axis in order] != list(shape):
        order = [0, 1, 2]
    mirrored = [2 + axis for axis in range(3) if torch.rand(()) < 0.5]
    dims = [0, 1, *[2 + axis for axis in order]]
    return {
        name: value.permute(dims).flip(mirrored).contiguous() if value.ndim == 5 else value
        for name, value in batch.items()
    }
