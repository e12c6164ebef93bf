"""Simulation of stacks of a moving head from a volume, with the true pose of every slice.

A pixel is a weighted sum of samples of the volume, spread over the slice's profile (`data_synth.slice_profile`).
Evaluation and training use the same simulator. It implements bias field and Rician noise itself instead of using
torchio and MONAI: the field is fixed to the scanner over a whole stack and defined per millimetre, and evaluations
must not change with the versions of those libraries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, zoom
from scipy.spatial.transform import Rotation

from data_synth.motion import LEVELS, MotionLevel, slice_trajectory
from data_synth.slice_profile import Profile, ProfileOperator
from g3r.acquisition.planes import Planes
from g3r.acquisition.stacks import Stack
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.errors import InputError
from g3r.geometry import RigidPose, VolumeGrid

Orientation = Literal["axial", "coronal", "sagittal", "random"]

# Columns: in-plane x, in-plane y, normal (right-handed).
FRAMES = {
    "axial": np.eye(3),
    "coronal": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "sagittal": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
}

FIELD_OF_VIEW_MARGIN_MM = 5.0
"""Margin of the field of view around the head at rest. Motion may move a part of the head out of view, as in a
scanner."""

SIMULATOR_VERSION = 2
"""Version of stored slices, to be raised when the same settings give other slices. Since version 2 a pixel of the
`box` and `sinc` profiles averages over its own area in plane."""

SIGNAL_REACH_MM = 3.2
"""Distance from the mask, rounded to voxels and measured along the axes of its grid, beyond which pixels are not
computed and show only noise. Thick slices reach further (`reach_voxels`)."""

PROFILE_REACH = 0.6
"""Outer end of the edge of the `box` profile, in thicknesses from the centre of the slice."""


@dataclass(frozen=True, kw_only=True)
class StackSettings:
    """Acquisition settings of one stack.

    Args:
        orientation: of the slices in the head's frame.
        resolution_mm: in-plane pixel spacing.
        thickness_mm: slice thickness.
        gap_mm: gap between the facing edges of neighbouring slices (slice spacing minus thickness), at least
            -0.9 thickness_mm; negative for overlapping slices.
        motion: amount of motion.
        interleave: 1 sequential, 2 every other slice first, 3 every third.
        oblique_deg: standard deviation per axis of a tilt of the slices, which the header states.
        profile: through the slice, `box` with soft edges (what scanners aim for), `gaussian` (the model's) or `sinc`
            (of a short pulse).
        snr: half the 99.5th percentile in the mask over the standard deviation of the noise; infinity for no noise.
        bias: strength of the smooth in-plane inhomogeneity; 0 for none.
        gain_deviation: standard deviation of the slices' log gains.
    """

    orientation: Orientation = "axial"
    resolution_mm: float = 0.8
    thickness_mm: float = 2.2
    gap_mm: float = 0.0
    motion: MotionLevel = field(default_factory=MotionLevel)
    interleave: int = 2
    oblique_deg: float = 0.0
    profile: Profile = "box"
    snr: float = 25.0
    bias: float = 0.05
    gain_deviation: float = 0.05

    def __post_init__(self) -> None:
        checks = {
            "resolution": (self.resolution_mm, 0.1, 5.0),
            "thickness": (self.thickness_mm, 0.1, 20.0),
            "gap": (self.gap_mm, -0.9 * self.thickness_mm, 20.0),
            "snr": (self.snr, 0.1, np.inf),
            "bias": (self.bias, 0.0, 1.0),
            "gain deviation": (self.gain_deviation, 0.0, 1.0),
        }
        for name, (value, low, high) in checks.items():
            if not low <= value <= high:
                raise InputError(f"simulated stack: {name} of {value:g}; expected {low:g} to {high:g}")


@dataclass(frozen=True)
class SimulatedStack:
    """A simulated stack and its true motion and gains.

    Args:
        stack: as from a scanner; its header states the geometry without motion.
        true_pose: [K] a point of slice k that the header puts at x is truly at R x + t.
        gain: [K] intensity factor of each slice, including dropouts.
        dropout: [K] whether the slice lost its signal.
    """

    stack: Stack
    true_pose: RigidPose
    gain: NDArray[np.float64]
    dropout: NDArray[np.bool_]


def orthogonal_settings(n_stacks: int, motion: str = "none", **common: object) -> list[StackSettings]:
    """Settings of axial, coronal, sagittal, axial, ... stacks with all other settings in common."""
    if motion not in LEVELS:
        raise InputError(f"motion '{motion}'; expected one of {', '.join(LEVELS)}")
    names: tuple[Orientation, ...] = ("axial", "coronal", "sagittal")
    return [
        StackSettings(orientation=names[n % 3], motion=LEVELS[motion], **common)  # type: ignore[arg-type]
        for n in range(n_stacks)
    ]


def simulate_stacks(
    volume: NDArray[np.float32],
    mask: NDArray[np.bool_],
    affine: NDArray[np.float64],
    settings: Sequence[StackSettings],
    rng: np.random.Generator,
    *,
    fine: bool = False,
) -> list[SimulatedStack]:
    """Simulate stacks of a volume.

    Args:
        volume: [I, J, K] intensities; anything further than `reach_voxels` from the mask is ignored.
        mask: [I, J, K] the head.
        affine: [4, 4] RAS+ mm from index.
        settings: one entry per stack.
        rng: source of randomness; each stack draws from a child of its own.
        fine: first resample the volume to half the voxel size by cubic splines. This takes seconds longer and keeps
            the finest detail of a volume that is hardly finer than the stacks.

    Raises:
        InputError: an empty mask, or a stack that shows nothing of the head.
    """
    if not mask.any():
        raise InputError("simulation: the mask is empty; expected the head to be marked")
    # one head per reach, so that a stack does not depend on the thickness of the other stacks
    reaches = [reach_voxels(affine, one.thickness_mm) for one in settings]
    heads = {n: _Head.within(volume, mask, affine, n, fine) for n in set(reaches)}
    return [
        _simulate_stack(heads[n], one, child, f"stack-{number}")
        for number, (n, one, child) in enumerate(zip(reaches, settings, rng.spawn(len(settings)), strict=True))
    ]


def reach_voxels(affine: NDArray[np.float64], thickness_mm: float) -> int:
    """Distance beyond the mask up to which slices show signal, in voxels along the axes of the grid.

    Args:
        affine: [4, 4] of the grid; the smallest voxel edge is used.
        thickness_mm: of the slices.
    """
    voxel_mm = float(np.linalg.norm(affine[:3, :3], axis=0).min())
    of_profile = int(np.ceil(PROFILE_REACH * thickness_mm / voxel_mm - 1e-6))  # tolerance for rounding of the affine
    return max(round(SIGNAL_REACH_MM / voxel_mm), of_profile, 1)


@dataclass(frozen=True, kw_only=True)
class _Head:
    """The volume to be sliced, its mask, the region with signal, and surface points of the mask in the world."""

    volume: NDArray[np.float32]
    volume_grid: VolumeGrid
    mask: NDArray[np.float32]
    reach: NDArray[np.float32]
    mask_grid: VolumeGrid
    point_mm: NDArray[np.float64]
    center_mm: NDArray[np.float64]
    bright: float

    @classmethod
    def within(
        cls, volume: NDArray[np.float32], mask: NDArray[np.bool_], affine: NDArray[np.float64], n_reach: int, fine: bool
    ) -> _Head:
        """The head cropped from its volume, with signal up to `n_reach` voxels around it."""
        inside = np.argwhere(mask)
        low = np.maximum(inside.min(0) - n_reach - 1, 0)
        high = np.minimum(inside.max(0) + n_reach + 2, mask.shape)
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        volume, mask, affine = np.asarray(volume[box], np.float32), mask[box], affine.copy()
        affine[:3, 3] += affine[:3, :3] @ low
        grid = VolumeGrid(mask.shape, affine)
        reach = binary_dilation(mask, iterations=n_reach)
        shell = np.argwhere(mask & ~np.roll(mask, 1, 0) | mask & ~np.roll(mask, -1, 0))
        points = grid.world(shell[:: max(1, len(shell) // 4000)])
        extent = grid.world(np.argwhere(mask)[::7])
        bright = float(np.percentile(volume[mask], 99.5))
        volume_grid = grid
        if fine:
            shape = [2 * n - 1 for n in volume.shape]
            volume = zoom(volume, [m / n for m, n in zip(shape, volume.shape, strict=True)], order=3, mode="nearest")
            volume_grid = VolumeGrid(volume.shape, affine @ np.diag([0.5, 0.5, 0.5, 1.0]))
        return cls(
            volume=np.ascontiguousarray(volume, np.float32),
            volume_grid=volume_grid,
            mask=mask.astype(np.float32),
            reach=reach.astype(np.float32),
            mask_grid=grid,
            point_mm=points,
            center_mm=(extent.min(0) + extent.max(0)) / 2,
            bright=bright,
        )


def _simulate_stack(head: _Head, settings: StackSettings, rng: np.random.Generator, name: str) -> SimulatedStack:
    frame = _frame(settings, rng)
    spacing = np.array([settings.resolution_mm] * 2 + [settings.thickness_mm + settings.gap_mm])
    local = (head.point_mm - head.center_mm) @ frame
    half_mm = np.abs(local).max(0) + FIELD_OF_VIEW_MARGIN_MM
    shape = np.maximum(np.ceil(2 * half_mm / spacing).astype(int), [4, 4, 2])
    affine = np.eye(4)
    affine[:3, :3] = frame * spacing
    affine[:3, 3] = head.center_mm - affine[:3, :3] @ ((shape - 1) / 2)
    n_slices = int(shape[2])

    true_pose = slice_trajectory(n_slices, settings.motion, head.center_mm, settings.interleave, rng)
    middle = np.tile((shape - 1) / 2, (n_slices, 1))
    middle[:, 2] = np.arange(n_slices)
    nominal = Planes(
        rotation=np.tile(frame, (n_slices, 1, 1)),
        center_mm=middle @ affine[:3, :3].T + affine[:3, 3],
        spacing_mm=np.tile(spacing[:2], (n_slices, 1)),
        shape=np.tile(shape[:2], (n_slices, 1)),
        psf_var_mm2=np.zeros((n_slices, 3)),  # the profile is the simulator's own
    )
    planes = nominal.moved(true_pose)
    seen = np.flatnonzero(VoxelOperator(planes, head.mask_grid, None, (1, 1, 1)).forward(head.reach) > 0.01)
    mask = np.zeros(planes.n_pixels, bool)
    mask[seen] = VoxelOperator(planes, head.mask_grid, seen, (1, 1, 1)).forward(head.mask) > 0.5
    signal = np.zeros(planes.n_pixels)
    profile = (settings.resolution_mm, settings.thickness_mm, settings.profile)
    signal[seen] = ProfileOperator(planes, head.volume_grid, seen, *profile).forward(head.volume)
    signal = np.maximum(signal, 0).reshape(n_slices, *shape[:2])

    gain = np.exp(rng.normal(0, 1, n_slices) * settings.gain_deviation)
    dropout = rng.random(n_slices) < settings.motion.dropout_share
    gain = np.where(dropout, gain * rng.uniform(0.1, 0.5, n_slices), gain)
    image = signal * gain[:, None, None] * _bias(shape[:2], settings, rng)
    if np.isfinite(settings.snr):
        deviation = head.bright / (2 * settings.snr)
        noise = rng.standard_normal((2, *image.shape), dtype=np.float32) * np.float32(deviation)
        image = np.hypot(image + noise[0], noise[1])
    in_file = (1, 2, 0)  # planes are the first axis here, slices the last axis in the file
    mask3d = mask.reshape(n_slices, *shape[:2]).transpose(in_file)
    if not mask3d.any():
        raise InputError(f"simulation: {name} sees nothing of the head; use less motion or another seed")
    pixels = np.ascontiguousarray(image.transpose(in_file), dtype=np.float32)
    stack = Stack(
        image=pixels, mask=np.ascontiguousarray(mask3d), affine=affine, thickness_mm=settings.thickness_mm, name=name
    )
    return SimulatedStack(stack, true_pose, gain, dropout)


def _frame(settings: StackSettings, rng: np.random.Generator) -> NDArray[np.float64]:
    """Axes of the slices by the header: columns are in-plane x, in-plane y and normal."""
    if settings.orientation == "random":
        return Rotation.random(rng=rng).as_matrix()
    tilt = Rotation.from_rotvec(np.deg2rad(rng.normal(0, 1, 3) * settings.oblique_deg)).as_matrix()
    return tilt @ FRAMES[settings.orientation]


def _bias(shape: NDArray[np.int64], settings: StackSettings, rng: np.random.Generator) -> NDArray[np.float64]:
    """Smooth positive factor over the field of view, fixed for a stack as coil sensitivities are."""
    x, y = (np.linspace(-1, 1, n) * n * settings.resolution_mm / 80 for n in shape)
    c = rng.normal(size=5) * settings.bias
    x, y = x[:, None], y[None, :]
    return np.exp(c[0] * x + c[1] * y + c[2] * x * y + 0.5 * (c[3] * x**2 + c[4] * y**2))
