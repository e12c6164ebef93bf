"""Training of the mask network."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from monai.losses import DiceCELoss
from torch import Tensor

from g3r.mask_network.config import MaskNetworkConfig
from g3r.mask_network.model import MaskModel
from g3r.mask_network.network import MaskNetwork, normalised
from g3r.training.annealed_module import AnnealedModule

Batch = Mapping[str, Tensor]
"""`wide_image` and `wide_mask` [B, 1, A, B, K] in large pixels, `image` and `mask` [B, 1, H, W, K] of crops in small
ones; masks are shares of a pixel, 0 to 1."""

DEFAULT_NETWORK = MaskNetworkConfig()
MIN_TRUE_MM2 = 3000.0
"""Least area of brain, summed over slices, of an image that is scored by its Dice."""
N_PANEL_SLICES = 6


class MaskModule(AnnealedModule):
    """Supervised training of the mask network at both pixel sizes, by Dice and cross entropy over a whole batch.

    Args:
        network: see `MaskNetworkConfig`.
        learning_rate: peak rate of AdamW.
        weight_decay: weight decay of AdamW.
        warmup_steps: steps of linear warm-up.
        wide_weight: weight of the loss in large pixels relative to that in small ones.
        start_from: exported mask network, or training checkpoint of one, with the initial weights.

    Raises:
        ValueError: a rate is out of range, or from the network.
    """

    model_type = MaskModel
    network: MaskNetwork

    def __init__(
        self,
        network: MaskNetworkConfig = DEFAULT_NETWORK,
        learning_rate: float = 3e-3,
        weight_decay: float = 1e-4,
        warmup_steps: int = 50,
        wide_weight: float = 1.0,
        start_from: str | None = None,
    ) -> None:
        super().__init__(learning_rate, weight_decay, warmup_steps, start_from)
        if not wide_weight > 0:
            raise ValueError(f"got {wide_weight=}")
        self.keep_hyperparameters(network)
        self.wide_weight = wide_weight
        self.network = MaskNetwork(network)
        # one Dice for the whole batch, because an image without brain has no Dice of its own
        self._loss = DiceCELoss(sigmoid=True, batch=True)
        self._scores: list[dict[str, float]] = []
        self._panel: Tensor | None = None

    def n_samples(self, batch: Batch) -> int:
        """Number of stacks of a batch."""
        return len(batch["image"])

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the loss of one batch, and log both its parts."""
        find, outline = self._losses(batch)
        n_samples = self.n_samples(batch)
        self.log("train/find_loss", find, prog_bar=True, batch_size=n_samples)
        self.log("train/outline_loss", outline, prog_bar=True, batch_size=n_samples)
        return self.wide_weight * find + outline

    def on_validation_epoch_start(self) -> None:
        """Reset the scores of the last epoch."""
        self._scores = []

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Score one stack."""
        wide = torch.sigmoid(self.network(batch["wide_image"]))
        fine = torch.sigmoid(self.network(batch["image"]))
        self._scores.append(scores_of(wide, fine, batch, self.network.config))
        if batch_idx == 0:
            self._panel = panel(fine, batch)

    def on_validation_epoch_end(self) -> None:
        """Log the means of the scores, and a row of images."""
        for name, value in summary(self._scores).items():
            self.log(f"val/{name}", value, prog_bar=name == "outline_dice")
        if self._panel is not None:
            self.log_image("val/slices, the probability of brain, the truth", self._panel)

    def setup(self, stage: str) -> None:
        """Check that the pixel sizes of the data are those of the network.

        Raises:
            InputError: they differ.
        """
        self.check_data("wide_mm", "pixel_mm")

    def own_description(self) -> dict[str, Any]:
        """No values besides the weights."""
        return {}

    def _losses(self, batch: Batch) -> tuple[Tensor, Tensor]:
        find = self._loss(self.network(batch["wide_image"]), batch["wide_mask"])
        outline = self._loss(self.network(batch["image"]), batch["mask"])
        return find, outline


def dice(predicted: Tensor, true: Tensor) -> float:
    """Overlap of two masks, 0 to 1."""
    both = float((predicted & true).sum())
    return 2 * both / max(float(predicted.sum() + true.sum()), 1.0)


def scores_of(wide: Tensor, fine: Tensor, batch: Batch, config: MaskNetworkConfig) -> dict[str, float]:
    """Dice of an image with brain; without brain, the false-positive area over all slices, in square centimetres.

    Args:
        wide: [1, 1, A, B, K] probabilities in large pixels.
        fine: [1, 1, H, W, K] probabilities in small ones.
        batch: one stack.
        config: arguments of the network.
    """
    result = {}
    images = {"find": (wide, "wide_mask", config.wide_mm), "outline": (fine, "mask", config.pixel_mm)}
    for name, (probability, mask, pixel_mm) in images.items():
        true = batch[mask] > 0.5
        if float(true.sum()) * pixel_mm**2 > MIN_TRUE_MM2:
            result[f"{name}_dice"] = dice(probability > 0.5, true)
        elif not bool((batch[mask] > 0).any()):
            result[f"false_{name}_cm2"] = float((probability > 0.5).sum()) * pixel_mm**2 / 100
    return result


def summary(scores: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Means over the stacks that have a score."""
    names = sorted({name for one in scores for name in one})
    return {name: float(np.mean([one[name] for one in scores if name in one])) for name in names}


def panel(probability: Tensor, batch: Batch) -> Tensor:
    """Picture of slices of the first stack, with the probability of brain and the truth below them.

    Args:
        probability: [1, 1, H, W, K].
        batch: the batch of these probabilities.

    Returns:
        [rows, columns] in [0, 1].
    """
    n = batch["image"].shape[-1]
    chosen = torch.linspace(0, n - 1, N_PANEL_SLICES).round().long().unique().tolist()
    rows = (normalised(batch["image"]), probability, batch["mask"])
    return torch.cat([torch.cat([row[0, 0, :, :, k].float().cpu() for k in chosen], 1) for row in rows], 0).clamp(0, 1)
