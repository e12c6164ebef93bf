"""Scans of a scene: random contrast, slice plan and motion, and images of any part of the scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_synth.mask_head import SceneHead
from data_synth.mask_labels import Tissue, draw_intensities, textured
from data_synth.mask_slicing import image_slices
from data_synth.mask_surroundings import Surroundings
from data_synth.motion import LEVELS, slice_trajectory
from data_synth.stack_planning import planned_rotation
from g3r.geometry import RigidPose

Array = NDArray[np.float64]

LEVEL_SHARE = {"none": 0.2, "mild": 0.4, "moderate": 0.25, "severe": 0.15}
BLACK_SHARE = 0.05
"""Share of scans that are already brain-extracted: black outside brain and outer fluid."""
NEGATIVE_SHARE = 0.2
"""Share of scans without a head."""
PLANNED_SHARE = 0.65
CUT_SHARE = 0.2
"""Share of scans whose slices do not cover the whole head."""
VIEW_CUT_SHARE = 0.08
"""Share of scans whose field of view cuts the head."""
DROPOUT_SHARE = 0.03
BREATH_MM = 0.7
"""Standard deviation per axis of the mother's movement, drawn anew for each slice."""
N_THROUGH = 3


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A head and its surroundings, in the head's frame."""

    head: SceneHead
    around: Surroundings


@dataclass(frozen=True, kw_only=True)
class Scan:
    """A scan of a scene, with its contrast and slice poses.

    Args:
        scene: the scanned scene.
        head: [I, J, K, 3], see `image_slices`.
        behind: [N, N, N] intensities of the surroundings.
        head_pose: [S] poses that map the frame of each slice to the head's frame.
        scan_pose: [S] poses that map the frame of each slice to the scan's frame.
        spacing_mm: between slices.
        thickness_mm: of a slice.
        fov_mm: [2] edges of the field of view, which is centred on the slices' origins.
        centre_mm: [3] the head's centre in the frame of a slice at depth 0 in the middle of the field of view.
        depth_mm: [S] of the slices.
        gain: [S] of the slices.
        with_head: False where the scan shows none.
    """

    scene: Scene
    head: NDArray[np.float32]
    behind: NDArray[np.float32]
    head_pose: RigidPose
    scan_pose: RigidPose
    spacing_mm: float
    thickness_mm: float
    fov_mm: Array
    centre_mm: Array
    depth_mm: Array
    gain: NDArray[np.float32]
    with_head: bool

    def trunk_mm(self) -> Array:
        """Centre of the fetal trunk from the middle of the field of view, along rows, columns and slices [3]."""
        return self._seen_at(self.scene.around.trunk_mm)

    def below_head_mm(self, share: float) -> Array:
        """A point on the line from the head's centre through the start of the neck, in the frame of `trunk_mm`.

        Args:
            share: of the distance to the start of the neck; 1 is the start of the neck, more is beyond it.
        """
        return self._seen_at(share * self.scene.head.base_mm)

    def _seen_at(self, place_mm: Array) -> Array:
        return place_mm @ self.scan_pose.rotation[0] + self.centre_mm

    def images(
        self,
        first_mm: tuple[float, float],
        pixel_mm: float,
        shape: tuple[int, int],
        slices: slice = slice(None),
        n_through: int = N_THROUGH,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Images of a part of the scan, black beyond the field of view, and the share of each pixel in the mask.

        Args:
            first_mm: the first pixel's centre, from the middle of the field of view.
            pixel_mm: edge of the pixels.
            shape: pixels along both axes.
            slices: range of slices.
            n_through: samples through a slice.

        Returns:
            Images and shares, each [*shape, S].
        """
        head, around = self.scene.head, self.scene.around
        image, inside = image_slices(
            self.head,
            np.linalg.inv(head.affine),
            self.head_pose.take(slices),
            self.behind,
            np.linalg.inv(around.affine),
            self.scan_pose.take(slices),
            first_mm=first_mm,
            pixel_mm=pixel_mm,
            shape=shape,
            thickness_mm=self.thickness_mm,
            n_through=n_through,
        )
        image *= self.gain[slices]
        for axis in range(2):
            at = first_mm[axis] + np.arange(shape[axis]) * pixel_mm
            beyond = np.abs(at) > self.fov_mm[axis] / 2
            for one in (image, inside):
                np.moveaxis(one, axis, 0)[beyond] = 0
        return image, inside


def draw_scan(
    scene: Scene,
    rng: np.random.Generator,
    negative: bool | None = None,
    *,
    view_cut_share: float = VIEW_CUT_SHARE,
    level_share: Mapping[str, float] = LEVEL_SHARE,
) -> Scan:
    """A scan of a scene.

    Args:
        scene: to be scanned.
        rng: source of randomness.
        negative: True for a scan that shows no head; None draws it.
        view_cut_share: see `VIEW_CUT_SHARE`.
        level_share: probability of each level of motion; they sum to one.
    """
    if negative is None:
        negative = bool(rng.random() < NEGATIVE_SHARE)
    beside = negative and rng.random() < 0.4  # the head exists but is out of view
    head, behind = _coloured(scene, rng, hidden=negative and not beside)
    if rng.random() < PLANNED_SHARE:
        rotation = planned_rotation(int(rng.integers(3)), rng)
    else:
        rotation = Rotation.random(rng=rng).as_matrix()
    spacing = float(rng.uniform(2.0, 5.0) if rng.random() < 0.5 else rng.uniform(2.5, 4.0))
    radius = scene.head.radius_mm * 1.15
    low, high = -radius - float(rng.uniform(-5, 45)), radius + float(rng.uniform(-5, 45))
    if rng.random() < CUT_SHARE:
        cut = float(rng.uniform(0.1, 0.5)) * 2 * radius
        low, high = (low, radius - cut) if rng.random() < 0.5 else (cut - radius, high)
    if beside:
        shift = 1.2 * radius + float(rng.uniform(10, 20)) - low
        low, high = low + shift, high + shift
        if rotation[:, 2] @ scene.around.trunk_mm < 0:
            low, high = -high, -low
    depth = np.arange(low + rng.uniform(0, spacing), high, spacing)
    fov = rng.uniform(220, 400, 2)
    room = np.maximum(fov / 2 - radius, 10)
    offset: Array = rng.uniform(-0.85, 0.85, 2) * np.minimum(room, 90)
    if rng.random() < view_cut_share:
        axis = int(rng.integers(2))
        offset[axis] = np.sign(offset[axis]) * (fov[axis] / 2 - radius * rng.uniform(-0.2, 0.8))
    centre = np.append(offset, 0.0)
    # a slice's origin is the middle of the field of view at its depth; the scan's origin is the head's centre
    at = np.stack([np.full(len(depth), -offset[0]), np.full(len(depth), -offset[1]), depth], axis=1)
    header = RigidPose(np.broadcast_to(rotation, (len(depth), 3, 3)), at @ rotation.T)
    level = LEVELS[str(rng.choice(list(level_share), p=list(level_share.values())))]
    motion = slice_trajectory(len(depth), level, np.zeros(3), int(rng.integers(1, 4)), rng)
    breath = RigidPose.from_rotvec(np.zeros((len(depth), 3)), rng.normal(0, BREATH_MM, (len(depth), 3)))
    log_gain = rng.normal(0, rng.uniform(0, 0.08), len(depth))
    dropout = rng.random(len(depth)) < DROPOUT_SHARE
    log_gain[dropout] = np.log(rng.uniform(0.1, 0.7, int(dropout.sum())))
    return Scan(
        scene=scene,
        head=head,
        behind=behind,
        head_pose=motion @ header,
        scan_pose=breath @ header,
        spacing_mm=spacing,
        thickness_mm=spacing * (1.0 if rng.random() < 0.6 else float(rng.uniform(0.7, 1.1))),
        fov_mm=fov,
        centre_mm=centre,
        depth_mm=depth,
        gain=np.exp(log_gain).astype(np.float32),
        with_head=not negative,
    )


def _coloured(scene: Scene, rng: np.random.Generator, hidden: bool) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The three channels of the head (see `image_slices`) and the intensities of the surroundings, randomly drawn."""
    mean, texture = draw_intensities(rng)
    head, around = scene.head, scene.around
    volume = np.zeros((*head.labels.shape, 3), np.float32)
    behind = np.zeros(around.labels.shape, np.float32)
    black = not hidden and rng.random() < BLACK_SHARE
    if not black:
        behind = textured(around.labels, around.texture, mean, texture)
    if not hidden:
        brain = head.labels == Tissue.BRAIN
        if not black:
            volume[..., 0] = textured(head.labels, head.texture, mean, texture)
            volume[..., 1] = head.labels > 0
        elif (head.labels == Tissue.CSF).any():
            brain = brain | (head.labels == Tissue.CSF)
            volume[..., 0] = np.where(head.labels == Tissue.CSF, mean[Tissue.CSF], 0)
        shown = head.labels == Tissue.BRAIN
        volume[shown, 0] = head.brain[shown] ** np.float32(np.exp(rng.uniform(-0.4, 0.4)))
        volume[brain, 1] = 1
        volume[..., 2] = head.inside
    return volume, behind
