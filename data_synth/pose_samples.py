"""Training samples of the pose network: slice images with true poses in the atlas frame, each made in milliseconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from monai.transforms import RandRicianNoise
from numpy.typing import NDArray

from data_synth.slice_sampling import Head, sample_masks, sample_slices
from data_synth.stack_planning import draw_stacks
from data_synth.trajectories import RecordedTrajectory
from g3r.acquisition.slice_images import SliceImages
from g3r.geometry import RigidPose

Array = NDArray[np.float64]

DROPOUT_SHARE = 0.03
MAX_NOISE = 0.06
"""Largest standard deviation of the noise; the head's 99.5th percentile is 1."""
MIN_AREA_MM2 = 60.0
LOOK_PIXEL_MM, LOOK_SIZE = 5.0, 36
"""Pixel size and image size of the coarse masks that locate the head in the field of view."""


@dataclass(frozen=True)
class SliceSet:
    """Slice images of one head with their true poses.

    Args:
        images: input of the network.
        true_pose: [K] poses that map the frame of each image to the atlas frame.
    """

    images: SliceImages
    true_pose: RigidPose


def draw_slice_set(
    head: Head,
    rng: np.random.Generator,
    pixel_mm: float = 3.0,
    size: int = 40,
    max_slices: int = 64,
    n_stacks: int | None = None,
    recorded: Sequence[RecordedTrajectory] = (),
) -> SliceSet:
    """A random slice set of a head: stacks are planned, moved and sliced; shape and intensities are varied.

    Args:
        head: the truth.
        rng: source of randomness.
        pixel_mm: edge of the square pixels.
        size: pixels per edge.
        max_slices: of all stacks together; a larger set is thinned, and the excess dropped at random.
        n_stacks: None draws 1 to 6.
        recorded: trajectories to follow instead of the model's.
    """
    shape = _random_shape(rng)
    index_from_atlas = np.linalg.inv(head.affine) @ _homogeneous(np.linalg.inv(shape))
    corners = np.array(list(np.ndindex(2, 2, 2))) * (np.array(head.data.shape) - 1)
    corners = (corners @ head.affine[:3, :3].T + head.affine[:3, 3]) @ shape.T
    plan = draw_stacks(corners, rng, n_stacks, recorded)
    threshold = float(rng.uniform(0.3, 0.6))

    # coarse masks of the moved slices, which the header poses then place
    look = sample_masks(head, index_from_atlas, plan.true_pose, LOOK_PIXEL_MM, LOOK_SIZE, threshold)
    area = look.sum((1, 2)) * LOOK_PIXEL_MM**2
    kept = _thinned(np.flatnonzero(area > MIN_AREA_MM2), max_slices, rng)
    plan, look, area = plan.take(kept), look[kept], area[kept]
    _, stack_id = np.unique(plan.stack_id, return_inverse=True)
    translation_mm = _shift_to_centroid(look, area, plan.header_pose, stack_id)

    frame = RigidPose.from_rotvec(np.zeros_like(translation_mm), translation_mm * [1, 1, 0])
    true = plan.true_pose @ frame
    image, inside = sample_slices(head, index_from_atlas, true, plan.thickness_mm, pixel_mm, size, threshold)
    image = _random_intensities(image, inside, true, pixel_mm, rng)
    bright = np.percentile(image[inside > 0.5], 99) if (inside > 0.5).any() else 1.0
    images = SliceImages(
        image=(image / max(bright, 1e-6)).astype(np.float32),
        area_mm2=inside.sum((1, 2)) * pixel_mm**2,
        position_mm=-translation_mm[:, 2],
        thickness_mm=plan.thickness_mm,
        time_rank=plan.time_rank,
        stack_id=stack_id.astype(np.int64),
        header_rotation=plan.header_pose.rotation,
        frame_in_slice=frame,
    )
    return SliceSet(images, true)


def _thinned(kept: NDArray[np.int64], max_slices: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """At most `max_slices` slices: every n-th one, less a few that are dropped at random."""
    if len(kept) > max_slices:
        stride = len(kept) // max_slices
        kept = kept[int(rng.integers(stride)) :: stride]
    if len(kept) > max_slices:
        kept = np.sort(rng.permutation(kept)[:max_slices])
    return kept


def _shift_to_centroid(look: NDArray[np.float32], area: Array, header: RigidPose, stack_id: NDArray[np.int64]) -> Array:
    """Vectors [K, 3] (mm, slice axes) from slice centres to the centroid of the stack's mask, by the headers."""
    at = (np.arange(LOOK_SIZE) - (LOOK_SIZE - 1) / 2) * LOOK_PIXEL_MM
    weight = np.maximum(look.sum((1, 2)), 1e-6)
    middle = np.stack([look.sum(2) @ at / weight, look.sum(1) @ at / weight, np.zeros(len(look))], axis=1)
    world = header.apply(middle)
    total = np.bincount(stack_id, area)
    centroid = np.stack([np.bincount(stack_id, area * world[:, a]) / total for a in range(3)], axis=1)
    return header.inverse().apply(centroid[stack_id])


def _random_shape(rng: np.random.Generator) -> Array:
    """A random linear map near the identity: size varied by 10 %, each axis by 4 %; half are mirrored left-right."""
    stretch = np.exp(rng.uniform(-0.1, 0.1) + rng.normal(0, 0.04, 3).clip(-0.08, 0.08))
    stretch[0] *= rng.choice([-1.0, 1.0])
    return np.diag(stretch)


def _homogeneous(linear: NDArray[np.floating]) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    return matrix


def _random_intensities(
    image: NDArray[np.float32], inside: NDArray[np.float32], pose: RigidPose, pixel_mm: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Gamma, a gain for each slice, a bias field, dropout and Rician noise.

    The logarithm of the bias field is one linear slope in the atlas frame, common to all slices of a head.
    torchio's `RandomBiasField` would give each image its own field.

    Args:
        image: [K, N, N] slices, 0 to about 1.
        inside: [K, N, N] the mask's share of each pixel.
        pose: [K] poses that map the frame of each slice to the atlas frame.
        pixel_mm: edge of the square pixels.
        rng: source of randomness.
    """
    n, size = len(image), image.shape[1]
    image = image ** np.float32(np.exp(rng.uniform(-0.4, 0.4)))
    log_field = log_bias(rng.normal(0, 0.1, 3) / 50.0, pose, pixel_mm, size)
    log_gain = rng.normal(0, rng.uniform(0, 0.1), n)
    dropout = rng.random(n) < DROPOUT_SHARE
    log_gain = np.where(dropout, np.log(rng.uniform(0.1, 0.7, n)), log_gain)
    field = np.exp(log_gain[:, None, None] + log_field).astype(np.float32)
    noise = RandRicianNoise(prob=1.0, std=MAX_NOISE)
    noise.set_random_state(int(rng.integers(2**32)))
    return np.asarray(noise(image * field)) * inside


def log_bias(slope_per_mm: Array, pose: RigidPose, pixel_mm: float, size: int) -> Array:
    """Logarithm [K, N, N] of a bias field that rises along one direction of the atlas frame.

    Args:
        slope_per_mm: [3] of the logarithm, along the axes of the atlas frame; the logarithm is 0 at the origin.
        pose: [K] poses that map the frame of each slice to the atlas frame.
        pixel_mm: edge of the square pixels.
        size: N, pixels per edge.
    """
    at = (np.arange(size) - (size - 1) / 2) * pixel_mm
    along = slope_per_mm @ pose.rotation  # [K, 3] per mm along each slice's axes
    in_middle = pose.translation_mm @ slope_per_mm
    return in_middle[:, None, None] + along[:, 0, None, None] * at[:, None] + along[:, 1, None, None] * at
