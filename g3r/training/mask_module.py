"""Training of the mask networks."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from monai.losses import DiceCELoss
from torch import Tensor

from g3r.errors import InputError
from g3r.mask_network.config import MaskNetworkConfig
from g3r.mask_network.inference import candidates
from g3r.mask_network.model import MaskModel
from g3r.mask_network.network import MaskNetwork, normalised
from g3r.training.annealed_module import AnnealedModule

Batch = Mapping[str, Tensor]
"""`coarse_image` and `coarse_mask` [B, 1, A, B, C] of whole stacks, `image` and `mask` [B, 1, H, W, K] of crops;
masks are shares of a pixel, 0 to 1."""

DEFAULT_NETWORK = MaskNetworkConfig()
MIN_TRUE_ML = 5.0
"""Images that hold less brain are not scored by their Dice."""
N_PANEL_SLICES = 6


class MaskModule(AnnealedModule):
    """Supervised training of both mask networks: Dice and cross entropy, of a batch as a whole.

    Args:
        network: see `MaskNetworkConfig`.
        learning_rate: peak rate of AdamW.
        weight_decay: of AdamW.
        warmup_steps: steps of linear warm-up.
        finder_weight: of the localiser's loss relative to the outline's; they share no weights.
        start_from: training checkpoint whose weights to begin with.

    Raises:
        ValueError: a rate out of range, or from the network.
    """

    kind = MaskModel.kind
    network: MaskNetwork

    def __init__(
        self,
        network: MaskNetworkConfig = DEFAULT_NETWORK,
        learning_rate: float = 4e-3,
        weight_decay: float = 1e-4,
        warmup_steps: int = 50,
        finder_weight: float = 1.0,
        start_from: str | None = None,
    ) -> None:
        super().__init__(learning_rate, weight_decay, warmup_steps)
        if not finder_weight > 0:
            raise ValueError(f"got {finder_weight=}")
        self.keep_hyperparameters(network)
        self.finder_weight = finder_weight
        self.network = MaskNetwork(network)
        if start_from is not None:
            self._take_weights(start_from)
        # one Dice of the whole batch: an image without brain has none of its own
        self._loss = DiceCELoss(sigmoid=True, batch=True)
        self._scores: list[dict[str, float]] = []
        self._panel: Tensor | None = None

    def n_samples(self, batch: Batch) -> int:
        """Stacks of a batch."""
        return len(batch["image"])

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the loss of one batch, and log that of each network."""
        find, outline = self._losses(batch)
        n_samples = self.n_samples(batch)
        self.log("train/find_loss", find, prog_bar=True, batch_size=n_samples)
        self.log("train/outline_loss", outline, prog_bar=True, batch_size=n_samples)
        return self.finder_weight * find + outline

    def on_validation_epoch_start(self) -> None:
        """Forget the last epoch's scores."""
        self._scores = []

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Score one stack."""
        coarse = torch.sigmoid(self.network.find(batch["coarse_image"]))
        fine = torch.sigmoid(self.network.outline(batch["image"]))
        self._scores.append(scores_of(coarse, fine, batch, self.network.config))
        if batch_idx == 0:
            self._panel = panel(fine, batch)

    def on_validation_epoch_end(self) -> None:
        """Log the scores' means, and send a row of images."""
        for name, value in summary(self._scores).items():
            self.log(f"val/{name}", value, prog_bar=name == "outline_dice")
        for board in self.loggers:
            if isinstance(board, TensorBoardLogger) and self._panel is not None:
                board.experiment.add_image(
                    "val/slices, the probability of brain, the truth",
                    self._panel,
                    global_step=self.global_step,
                    dataformats="HW",
                )

    def setup(self, stage: str) -> None:
        """Compare the data's resolutions with the network's.

        Raises:
            InputError: they differ.
        """
        settings = self.describe_data()
        for name in ("coarse_mm", "pixel_mm"):
            mine, theirs = getattr(self.network.config, name), settings.get(name)
            if theirs is not None and theirs != mine:
                raise InputError(f"data.{name}: {theirs}, but the network looks at {mine}; leave it out")

    def own_description(self) -> dict[str, Any]:
        """Nothing apart from the weights."""
        return {}

    def _losses(self, batch: Batch) -> tuple[Tensor, Tensor]:
        find = self._loss(self.network.find(batch["coarse_image"]), batch["coarse_mask"])
        outline = self._loss(self.network.outline(batch["image"]), batch["mask"])
        return find, outline

    def _take_weights(self, path: str) -> None:
        """Begin with the weights of another run."""
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)["state_dict"]
            prefix = "network."
            self.network.load_state_dict({n.removeprefix(prefix): v for n, v in state.items() if n.startswith(prefix)})
        except Exception as error:  # torch.load says "damaged" in many types
            raise InputError(
                f"model.start_from: {path} cannot be used ({type(error).__name__}); expected a training "
                "checkpoint of these mask networks"
            ) from error


def dice(predicted: Tensor, true: Tensor) -> float:
    """Overlap of two masks, 0 to 1."""
    both = float((predicted & true).sum())
    return 2 * both / max(float(predicted.sum() + true.sum()), 1.0)


def scores_of(coarse: Tensor, fine: Tensor, batch: Batch, config: MaskNetworkConfig) -> dict[str, float]:
    """Dice of both networks and the error of the found head's centre where there is a head; what is found elsewhere.

    Args:
        coarse: [1, 1, A, B, C] probabilities of the localiser.
        fine: [1, 1, H, W, K] probabilities of the outline.
        batch: one stack.
        config: of the networks.
    """
    voxel_ml = config.coarse_mm**3 / 1000
    found = candidates(coarse[0, 0].float().cpu().numpy(), config.coarse_mm)
    is_head = bool(found) and found[0].is_head
    true = batch["coarse_mask"][0, 0].cpu() > 0.5
    result = {}
    if not bool((batch["coarse_mask"] > 0).any()):
        return {"false_heads": float(is_head)}
    if float(true.sum()) * voxel_ml > 2 * MIN_TRUE_ML:
        result["found"] = float(is_head)
        result["find_dice"] = dice(coarse[0, 0].cpu() > 0.5, true)
        if is_head:
            off = np.argwhere(found[0].inside).mean(0) - np.argwhere(true.numpy()).mean(0)
            result["centre_mm"] = float(np.linalg.norm(off) * config.coarse_mm)
    outlined = batch["mask"] > 0.5
    if float(outlined.sum()) * config.pixel_mm**3 / 1000 > MIN_TRUE_ML:
        result["outline_dice"] = dice(fine > 0.5, outlined)
    return result


def summary(scores: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Means over the stacks that have a score, and the median of the centres' errors."""
    result = {}
    for name in ("outline_dice", "find_dice", "found", "false_heads", "centre_mm"):
        values = [one[name] for one in scores if name in one]
        if values:
            result[name] = float(np.median(values) if name == "centre_mm" else np.mean(values))
    return result


def panel(probability: Tensor, batch: Batch) -> Tensor:
    """Picture of slices of the first stack, the probability of brain below them, and the truth.

    Args:
        probability: [1, 1, H, W, K].
        batch: that it is of.

    Returns:
        [rows, columns] in [0, 1].
    """
    n = batch["image"].shape[-1]
    chosen = torch.linspace(0, n - 1, N_PANEL_SLICES).round().long().unique().tolist()
    rows = (normalised(batch["image"]), probability, batch["mask"])
    return torch.cat([torch.cat([row[0, 0, :, :, k].float().cpu() for k in chosen], 1) for row in rows], 0).clamp(0, 1)
