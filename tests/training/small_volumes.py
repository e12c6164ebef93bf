"""Training volumes of the prior network, made in memory."""

from __future__ import annotations

import torch

from g3r.prior.inputs import PriorInputs


def smooth_noise(generator: torch.Generator, size: int) -> torch.Tensor:
    coarse_noise = torch.rand(1, 1, size // 4, size // 4, size // 4, generator=generator)
    return torch.nn.functional.interpolate(coarse_noise, scale_factor=4, mode="trilinear")[0]


def sample(seed: int, size: int = 16) -> dict[str, torch.Tensor]:
    """One training sample: a smooth truth, and coarse volumes that are wrong where the density is low."""
    generator = torch.Generator().manual_seed(seed)
    truth, density = smooth_noise(generator, size), 3 * smooth_noise(generator, size)
    error = -0.5 * torch.exp(-density) * truth + 0.02 * torch.randn(truth.shape, generator=generator)
    mask = torch.ones_like(truth)
    mask[:, :3] = 0
    coarse, sharp = mask * (truth + error), mask * (truth + 0.8 * error)
    return {
        "coarse": coarse,
        "density": density,
        "share": mask,
        "sharp": sharp,
        "template": mask * truth.mean(),
        "outline": mask,
        "truth": mask * truth,
        "mask": mask,
    }


def given_at_random(*shape: int) -> PriorInputs:
    """Random inputs of a network."""
    names = ("coarse", "density", "share", "sharp", "template", "outline")
    return PriorInputs(**{name: torch.rand(1, 1, *shape) for name in names})
