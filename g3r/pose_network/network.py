"""The pose network: a set transformer over all slices of all stacks that puts each into the atlas frame."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor, nn

from g3r.pose_network.blocks import Encoder, SetTransformer
from g3r.pose_network.config import PoseNetworkConfig
from g3r.pose_network.geometry import (
    best_age,
    group_mean,
    moved_points,
    nearest_rotation,
    pixel_points_mm,
    rotation_from_vector,
    sample_rows,
    scattered,
    smoothed,
)

WAVELENGTHS_MM = (200.0, 100.0, 50.0, 25.0)
"""Wavelengths of the codes of a slice's position along its stack."""
TRANSLATION_SCALE_MM = 20.0
RESIDUAL_SCALE_RAD = 0.3
RESIDUAL_SCALE_MM = 8.0
COARSE_SHAPE, COARSE_SPACING_MM = 28, 5.0
N_CODES = 2 * len(WAVELENGTHS_MM) + 5
N_POSE_CODES = 12
SIDE_MM = 4.0
"""Distance from the slice's plane, on both sides, at which a refinement also samples the atlas template."""
N_SEEN = 7

SliceBatch = Mapping[str, Tensor]
"""`image` [S, 1, N, N], `area_mm2`, `position_mm`, `thickness_mm`, `time_rank` [S] (NaN: unknown),
`stack` [S] (numbered through all sets), `set_of_stack` [G], `header_rotation` [S, 3, 3]: see `SliceImages`
and `g3r.pose_network.inference.slice_batch`."""


Disturbance = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Maps rotations [S, 3, 3] and translations [S, 3] (mm) to disturbed ones."""


class PoseStep(NamedTuple):
    """Output of one step of the network: poses (atlas frame from image frame), and the votes behind them.

    Attributes:
        rotation: [S, 3, 3].
        translation_mm: [S, 3].
        vote: [S, 3, 3] each slice's own vote for its rotation, not orthonormal: the less certain, the smaller.
    """

    rotation: Tensor
    translation_mm: Tensor
    vote: Tensor


class PoseNetwork(nn.Module):
    """Network that predicts slice poses in the atlas frame, by a first guess and refinements.

    Only rotations between stacks are taken from the headers, so rotating all headers together changes nothing, and
    neither does reordering slices or stacks. In each step every slice votes for a rotation and a translation of its
    stack. Votes of a stack are averaged; those of other stacks are added through the header's
    rotations between stacks (first step) or as they are (refinements); the sum is made a rotation. Then every
    slice adds a small motion of its own. Refinements see, at the current poses, the atlas template of the best age
    and a coarse volume of the *other* stacks (the feedback of SVoRT, Xu et al., MICCAI 2022).

    Args:
        config: see `PoseNetworkConfig`.
    """

    template: Tensor

    def __init__(self, config: PoseNetworkConfig) -> None:
        super().__init__()
        self.config = config
        ages, *shape = config.template_shape
        # [I, J, K, A]: all ages of a voxel are adjacent in memory, for sampling
        self.register_buffer("template", torch.zeros(*shape, ages))
        self.encoder = Encoder(config.channels, config.width, config.image_size)
        self.transformer = SetTransformer(config.width, N_CODES, config.n_blocks, config.n_heads)
        self.refining_encoder = Encoder(config.channels, config.width, config.image_size, N_SEEN)
        self.refining_transformer = SetTransformer(
            config.width, N_CODES + N_POSE_CODES, config.n_blocks, config.n_heads
        )
        # weight of the votes of all stacks relative to the stack's own, in the first step and in refinements
        self.log_share = nn.Parameter(torch.zeros(2))

    def set_template(self, volume: Tensor) -> None:
        """Set the atlas template [A, I, J, K], on a grid centred on the origin; no weight depends on its shape."""
        self.config = replace(self.config, template_shape=tuple(volume.shape))
        self.template = volume.permute(1, 2, 3, 0).contiguous().to(self.template)

    def forward(
        self, batch: SliceBatch, n_refinements: int | None = None, disturb: Disturbance | None = None
    ) -> list[PoseStep]:
        """The first guess and the result of each refinement.

        Args:
            batch: slices of one or more heads.
            n_refinements: number of refinements; None takes that of `config`.
            disturb: changes the poses from which a refinement starts, in training.
        """
        # only the encoder uses mixed precision; poses and points stay in float32
        with torch.autocast(batch["image"].device.type, enabled=False):
            return self._steps(batch, n_refinements, disturb)

    def _steps(self, batch: SliceBatch, n_refinements: int | None, disturb: Disturbance | None) -> list[PoseStep]:
        stack, set_of_stack = batch["stack"], batch["set_of_stack"]
        n_stacks, n_sets = len(set_of_stack), int(set_of_stack.max()) + 1
        same_stack = stack[:, None] == stack
        of_set = set_of_stack[stack]
        same_set = of_set[:, None] == of_set
        code = slice_codes(batch)
        header = group_mean(batch["header_rotation"].to(code.dtype), stack, n_stacks)

        vote = self.transformer(self.encoder(batch["image"]), code, same_stack, same_set)
        votes = vote[:, :9].reshape(-1, 3, 3)
        matrix = group_mean(votes, stack, n_stacks)
        # each stack's vote, transferred to the other stacks of its head by the headers
        carried = group_mean(matrix @ header.transpose(1, 2), set_of_stack, n_sets)[set_of_stack] @ header
        rotation = nearest_rotation(matrix + self.log_share[0].exp() * carried)[stack]
        shift = group_mean(vote[:, 9:12], stack, n_stacks)[stack] * TRANSLATION_SCALE_MM
        along = batch["position_mm"].to(code.dtype)[:, None]
        steps = [PoseStep(*_with_residual(rotation, shift + rotation[:, :, 2] * along, vote[:, 12:]), votes)]

        for _ in range(self.config.n_refinements if n_refinements is None else n_refinements):
            rotation, translation = steps[-1].rotation.detach(), steps[-1].translation_mm.detach()
            if disturb is not None:
                rotation, translation = disturb(rotation, translation)
            seen = self._seen_at(rotation, translation, batch)
            pose_code = torch.cat([rotation.flatten(1), translation / 50.0], 1)
            token = self.refining_encoder(batch["image"], seen)
            vote = self.refining_transformer(token, torch.cat([code, pose_code], 1), same_stack, same_set)
            # the identity is a vote for the pose from which the refinement starts
            votes = torch.eye(3, dtype=code.dtype, device=code.device) + vote[:, :9].reshape(-1, 3, 3)
            matrix = group_mean(votes, stack, n_stacks)
            shared = group_mean(matrix, set_of_stack, n_sets)[set_of_stack]
            turn = nearest_rotation(matrix + self.log_share[1].exp() * shared)[stack]
            shift = group_mean(vote[:, 9:12], stack, n_stacks)[stack] * TRANSLATION_SCALE_MM
            moved = (turn @ translation[..., None])[..., 0] + shift
            steps.append(PoseStep(*_with_residual(turn @ rotation, moved, vote[:, 12:]), votes @ rotation))
        return steps

    @torch.no_grad()
    def _seen_at(self, rotation: Tensor, translation_mm: Tensor, batch: SliceBatch) -> Tensor:
        """Template and other stacks, sampled at the slices' poses, [S, N_SEEN, N / 2, N / 2].

        The atlas template of the age that correlates best with a set's slices is sampled in the slice's plane and on
        both sides of it. A coarse volume of the other stacks is sampled in the plane. Both also give differences from
        the slice.
        """
        half, spacing_mm = self.config.image_size // 2, self.config.template_spacing_mm
        value = nn.functional.avg_pool2d(batch["image"], 2).flatten(1)
        plane = pixel_points_mm(half, 2 * self.config.pixel_mm, value)
        stack, set_of_stack = batch["stack"], batch["set_of_stack"]
        heads = smoothed(self.template.permute(3, 0, 1, 2))
        points = moved_points(rotation, translation_mm, plane)
        # a quarter of the pixels is enough to determine the age
        some = sample_rows(heads.permute(1, 2, 3, 0), points[:, ::4], spacing_mm)
        age = best_age(some, value[:, ::4], set_of_stack[stack], int(set_of_stack.max()) + 1)
        head = [
            sample_rows(
                heads[..., None],
                moved_points(rotation, translation_mm, plane + plane.new_tensor([0.0, 0.0, side_mm])),
                spacing_mm,
                age[set_of_stack[stack]],
            )
            for side_mm in (-SIDE_MM, 0.0, SIDE_MM)
        ]
        mean, known = self._others_at(points, value, stack, set_of_stack)
        slice_ = value[..., None]
        seen = torch.cat([*head, slice_ - head[1], mean, (slice_ - mean) * known, known], -1)
        return seen.reshape(len(value), half, half, -1).permute(0, 3, 1, 2)

    def _others_at(
        self, points_mm: Tensor, value: Tensor, stack: Tensor, set_of_stack: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Coarse volume of the head's other stacks at the pixels [S, P, 1], and where it is known, 0 to 1."""
        n_stacks, n_sets = len(set_of_stack), int(set_of_stack.max()) + 1
        weight = (value > 0).to(value.dtype)
        sums = scattered(points_mm, value, weight, stack, n_stacks, COARSE_SHAPE, COARSE_SPACING_MM)
        per_set = sums.new_zeros(n_sets, *sums.shape[1:]).index_add(0, set_of_stack, sums)
        others = per_set[set_of_stack] - sums
        coarse = sample_rows(others, points_mm, COARSE_SPACING_MM, stack)
        weight = coarse[..., 1:].clamp_min(0)
        return coarse[..., :1] / (weight + 0.02), weight / (weight + 0.1)


def slice_codes(batch: SliceBatch) -> Tensor:
    """Codes [S, N_CODES] of the facts about a slice apart from its image: position, thickness, area, rank in time.

    The rank is known in training only: image files do not state the order of acquisition, so reconstruction always
    passes "unknown" (NaN), which training includes, too.
    """
    image = batch["image"]
    position, thickness, area, rank = (
        batch[name].to(image.dtype) for name in ("position_mm", "thickness_mm", "area_mm2", "time_rank")
    )
    phase = position[:, None] * (2 * torch.pi / position.new_tensor(WAVELENGTHS_MM))
    known = torch.isfinite(rank)
    plain = [position / 50.0, thickness / 5.0, area / 5000.0, torch.where(known, 2 * rank - 1, 0.0), known]
    return torch.cat([torch.sin(phase), torch.cos(phase), torch.stack([p.to(phase) for p in plain], 1)], 1)


def _with_residual(rotation: Tensor, translation_mm: Tensor, vote: Tensor) -> tuple[Tensor, Tensor]:
    """The stack's pose of each slice, followed by the slice's own rotation and translation in its own frame."""
    shift = (rotation @ (vote[:, 3:] * RESIDUAL_SCALE_MM)[..., None])[..., 0]
    return rotation @ rotation_from_vector(vote[:, :3] * RESIDUAL_SCALE_RAD), translation_mm + shift
