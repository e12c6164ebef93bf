"""Training of the pose network."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from g3r.pose_network.config import PoseNetworkConfig
from g3r.pose_network.geometry import moved_points, rotation_from_vector
from g3r.pose_network.inference import as_pose, poses_of
from g3r.pose_network.model import PoseModel
from g3r.pose_network.network import PoseNetwork, PoseStep
from g3r.training.annealed_module import AnnealedModule
from g3r.training.pose_scores import SLICE_POINTS_MM, panel, scores_of, summary

Batch = Mapping[str, Tensor]
"""A `SliceBatch` with `true_rotation` [S, 3, 3] and `true_translation_mm` [S, 3]."""

DEFAULT_NETWORK = PoseNetworkConfig()
FULL_AREA_MM2 = 600.0
"""Slices with a smaller masked area are down-weighted in the loss."""
SECOND_REFINEMENT_SHARE = 0.2
"""Share of training batches with two refinements, so that a refinement also learns to start from good poses."""
DISTURBED_SHARE = 0.6
"""Share of heads with disturbed poses before a refinement, with at most the following deviations per axis."""
STACK_ROTATION_RAD, STACK_TRANSLATION_MM = 0.3, 6.0
SLICE_ROTATION_RAD, SLICE_TRANSLATION_MM = 0.1, 2.5
VOTE_WEIGHT_MM = 10.0
"""Weight of the votes' squared error (0 to 3, no unit) relative to the distances."""


class PoseModule(AnnealedModule):
    """Supervised training of the pose network against the slices' true poses.

    Loss: mean distance in mm of five points of a slice (its centre and (+-25, +-25) mm) between predicted and
    true pose, over all steps of the network; slices with a small mask weigh less. Added to it is the
    squared error of every slice's vote. From it a vote learns to be the mean of the rotations that the slice may have:
    long if they are certain, short if not.

    The poses from which a refinement starts are disturbed, because the first guess is better on training heads than on
    others.

    The atlas template comes from the data module's `template()`.

    Args:
        network: see `PoseNetworkConfig`; the template's shape is that of the data module's template.
        learning_rate: peak rate of AdamW.
        weight_decay: weight decay of AdamW.
        warmup_steps: steps of linear warm-up.
        start_from: exported pose network, or training checkpoint of one, with the initial weights.

    Raises:
        ValueError: a rate is out of range, or from the network.
    """

    model_type = PoseModel
    network: PoseNetwork

    def __init__(
        self,
        network: PoseNetworkConfig = DEFAULT_NETWORK,
        learning_rate: float = 1e-3,
        weight_decay: float = 1e-3,
        warmup_steps: int = 200,
        start_from: str | None = None,
    ) -> None:
        super().__init__(learning_rate, weight_decay, warmup_steps, start_from)
        self.keep_hyperparameters(network)
        self.network = PoseNetwork(network)
        self.weeks = []
        self._scores: list[dict[str, np.ndarray]] = []
        self._panel: Tensor | None = None

    def forward(self, batch: Batch) -> list[PoseStep]:
        """Poses after each step; see `PoseNetwork.forward`."""
        return self.network(batch)

    def n_samples(self, batch: Batch) -> int:
        """Number of heads of a batch."""
        return int(batch["set_of_stack"].max()) + 1

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the mean point distance of one batch over all steps, and log it for each."""
        n_refinements = 2 if torch.rand(()) < SECOND_REFINEMENT_SHARE else 1

        def disturb(rotation: Tensor, translation_mm: Tensor) -> tuple[Tensor, Tensor]:
            return disturbed(rotation, translation_mm, batch["stack"], batch["set_of_stack"])

        steps = self.network(batch, n_refinements, disturb)
        losses = [point_loss(step, batch) for step in steps]
        votes = [vote_loss(step, batch) for step in steps]
        for number in range(2):
            n_samples = self.n_samples(batch)
            self.log(f"train/mm_step{number}", losses[number], prog_bar=True, batch_size=n_samples)
            self.log(f"train/vote_step{number}", votes[number], batch_size=n_samples)
        return torch.stack(losses).mean() + VOTE_WEIGHT_MM * torch.stack(votes).mean()

    def on_validation_epoch_start(self) -> None:
        """Reset the scores of the last epoch."""
        self._scores = []

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Score one head: errors of slices by `poses_of`, and of stacks after the robust fit."""
        steps = self.network(batch)
        self._scores.append(scores_of(as_pose(*steps[0][:2]), poses_of(self.network, batch), batch))
        self.log("val/mm_loss", point_loss(steps[-1], batch), batch_size=1)
        if batch_idx == 0:
            self._panel = panel(steps[-1], batch, self.network)

    def on_validation_epoch_end(self) -> None:
        """Log medians over all slices and stacks, and by the number of stacks; log the row of images."""
        for name, value in summary(self._scores).items():
            self.log(f"val/{name}", value, prog_bar=name == "slice_mm")
        if self._panel is not None:
            self.log_image("val/slices, and the template at their poses", self._panel)

    def setup(self, stage: str) -> None:
        """Take the atlas template from the data module.

        Raises:
            InputError: the data module's image size or template grid differs from the network's.
        """
        self.check_data("pixel_mm", "image_size")
        self.take_template()

    def own_description(self) -> dict[str, Any]:
        """Values that a `PoseModel` needs besides its weights."""
        return {"weeks": self.weeks}


def point_loss(step: PoseStep, batch: Batch) -> Tensor:
    """Mean distance (mm) of five slice points from their true positions, a scalar."""
    rotation, translation_mm, _ = step
    points = torch.as_tensor(SLICE_POINTS_MM, dtype=rotation.dtype, device=rotation.device)
    true = moved_points(batch["true_rotation"], batch["true_translation_mm"], points)
    distance = ((moved_points(rotation, translation_mm, points) - true).square().sum(-1) + 1e-4).sqrt()
    weight = (batch["area_mm2"] / FULL_AREA_MM2).clamp(0.1, 1.0)
    return (weight[:, None] * distance).mean() / weight.mean()


def disturbed(rotation: Tensor, translation_mm: Tensor, stack: Tensor, set_of_stack: Tensor) -> tuple[Tensor, Tensor]:
    """Draw disturbed poses: an error common to each stack and one of each slice, of a random size per head.

    Args:
        rotation: [S, 3, 3] poses to disturb.
        translation_mm: [S, 3] translations of these poses.
        stack: [S] stack of each slice.
        set_of_stack: [T] head of each stack.

    Returns:
        Rotations [S, 3, 3] and translations [S, 3] in mm.
    """
    n_stacks, n_sets, n = len(set_of_stack), int(set_of_stack.max()) + 1, len(stack)

    def normal(rows: int) -> Tensor:
        return torch.randn(rows, 3, dtype=rotation.dtype, device=rotation.device)

    chosen = torch.rand(2, n_sets, 1, dtype=rotation.dtype, device=rotation.device)
    size = chosen[0] * (chosen[1] < DISTURBED_SHARE)
    of_stack, of_slice = size[set_of_stack], size[set_of_stack[stack]]
    turn = rotation_from_vector(normal(n_stacks) * of_stack * STACK_ROTATION_RAD)[stack]
    shift = (normal(n_stacks) * of_stack * STACK_TRANSLATION_MM)[stack]
    moved = (turn @ translation_mm[..., None])[..., 0] + shift
    own = rotation_from_vector(normal(n) * of_slice * SLICE_ROTATION_RAD)
    return turn @ rotation @ own, moved + normal(n) * of_slice * SLICE_TRANSLATION_MM


def vote_loss(step: PoseStep, batch: Batch) -> Tensor:
    """Mean squared distance (Frobenius) of the slices' votes from their true rotations, a scalar."""
    weight = (batch["area_mm2"] / FULL_AREA_MM2).clamp(0.1, 1.0)
    squared = (step.vote - batch["true_rotation"]).square().sum((1, 2))
    return (weight * squared).mean() / weight.mean()
