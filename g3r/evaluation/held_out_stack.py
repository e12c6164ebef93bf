"""Prediction of a held-out stack by a volume: a measure of quality without a truth.

Every method is judged alike. Each slice is placed in the volume by a rigid pose of its own, simulated there (a
Gaussian PSF), fitted in its intensities, and compared inside the mask where the volume covers the PSF. So cropping a
volume to its mask neither helps nor hurts.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from g3r.acquisition.images import Volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import normalised_slices
from g3r.acquisition.stacks import Stack
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.errors import InputError
from g3r.evaluation.metrics import psnr_db
from g3r.evaluation.slice_scores import SliceScore, score_slice
from g3r.registration.stack_in_volume import place_in_volume

PSF_POINTS = (3, 3, 7)

MIN_SUPPORT = 0.95
"""Least share of a pixel's PSF in voxels that the volume shows, for the pixel to count."""

MIN_PIXELS = 100
"""Slices with fewer counted pixels are left out."""

ERODED_PIXELS = 1
"""Default width of the mask's rim that does not count, in pixels."""

DATA_RANGE_PERCENTILE = 99
"""The data range is this percentile of the stack in its mask."""


@dataclass(frozen=True, kw_only=True)
class StackPrediction:
    """Scores of a held-out stack.

    Attributes:
        stack: name of its file.
        slices: scores of the slices with enough counted pixels.
        counted_share: counted pixels over those of the eroded masks.
        search_correlation: correlation of the stack with the volume before its slices were placed one by one.
    """

    stack: str
    slices: tuple[SliceScore, ...]
    counted_share: float
    search_correlation: float

    def _mean(self, name: str) -> float:
        """Mean of a score over the slices, weighted by pixels."""
        return float(np.average([getattr(s, name) for s in self.slices], weights=[s.n_pixels for s in self.slices]))

    def figures(self) -> dict[str, float]:
        """The scores of the stack: means over counted pixels, and the median correlation of its slices."""
        return {
            "psnr_db": psnr_db(float(np.sqrt(self._mean("mse")))),
            "ssim": self._mean("ssim"),
            "ncc": self._mean("ncc"),
            "median_ncc": float(np.median([s.ncc for s in self.slices])),
            "high_pass_ncc": self._mean("high_pass_ncc"),
            "counted_share": self.counted_share,
            "search_correlation": self.search_correlation,
            "n_slices": len(self.slices),
        }

    def record(self) -> dict[str, object]:
        """All scores, for JSON."""
        return {"stack": self.stack, **self.figures(), "slices": [asdict(one) for one in self.slices]}


@dataclass(frozen=True, kw_only=True)
class PredictedPixels:
    """A stack in its estimated poses in a volume, and its slices as predicted by the volume.

    Attributes:
        slices: K slices in their poses.
        value: [P] pixels as predicted by the volume, in its intensities.
        seen: [P] share of each pixel's PSF that lies where the volume counts.
        search_correlation: see `StackPrediction`.
    """

    slices: Slices
    value: NDArray[np.float32]
    seen: NDArray[np.float32]
    search_correlation: float

    def image(self, pixels: NDArray[Any], k: int) -> NDArray[Any]:
        """Slice `k` [H, W] of one value per pixel [P]."""
        planes = self.slices.planes
        return pixels[planes.offset[k] : planes.offset[k + 1]].reshape(tuple(planes.shape[k]))


def predict_stack(
    volume: Volume, stack: Stack, *, support: NDArray[np.bool_] | None = None, eroded_pixels: int = ERODED_PIXELS
) -> StackPrediction:
    """Compare a stack with its prediction by a volume.

    Args:
        volume: volume made without the stack, in any orientation.
        stack: the stack, with its mask.
        support: [I, J, K] voxels that count, among those that are not zero; None counts all of these. Use the same
            support to compare two volumes.
        eroded_pixels: width of the mask's rim that does not count.

    Raises:
        InputError: the volume or the stack cannot be used, or the stack is not found in the volume.
    """
    found = predicted_pixels(volume, stack, support=support)
    return score_prediction(found, stack.name, volume.name, eroded_pixels)


def predicted_pixels(volume: Volume, stack: Stack, *, support: NDArray[np.bool_] | None = None) -> PredictedPixels:
    """Find the slices of a stack in a volume, and simulate them there; for arguments see `predict_stack`.

    Raises:
        InputError: the volume or the stack cannot be used.
    """
    data = np.nan_to_num(volume.data, posinf=0.0, neginf=0.0)
    shown = data != 0 if support is None else support & (data != 0)
    scale = float(np.percentile(data[shown], DATA_RANGE_PERCENTILE)) if shown.any() else 0.0
    if not scale > 0:
        raise InputError(f"{volume.name}: shows nothing; expected a volume that is not zero where the head is")
    slices, _ = normalised_slices([stack])
    # the whole volume, because slices do not fit a cropped one
    slices, found = place_in_volume(slices, data / np.float32(scale), volume.grid, np.random.default_rng(0))
    predicted, seen = (_simulated(one, slices, volume) for one in (data, shown.astype(np.float32)))
    return PredictedPixels(slices=slices, value=predicted, seen=seen, search_correlation=found)


def score_prediction(found: PredictedPixels, stack: str, volume: str, eroded_pixels: int) -> StackPrediction:
    """Compare a stack with its prediction.

    Args:
        found: the prediction.
        stack: its name.
        volume: name of the volume.
        eroded_pixels: width of the mask's rim that does not count.

    Raises:
        InputError: the stack is not found in the volume.
    """
    slices = found.slices
    data_range = float(np.percentile(slices.masked_value, DATA_RANGE_PERCENTILE))
    scores, n_eroded = [], 0
    for k in range(len(slices)):
        inside = _eroded(found.image(slices.mask, k), eroded_pixels)
        counted = inside & (found.image(found.seen, k) > MIN_SUPPORT)
        n_eroded += int(inside.sum())
        if counted.sum() >= MIN_PIXELS:
            scores.append(
                score_slice(
                    found.image(found.value, k),
                    found.image(slices.value, k),
                    counted,
                    spacing_mm=slices.planes.spacing_mm[k],
                    data_range=data_range,
                    slice_index=int(slices.slice_index[k]),
                )
            )
    if not scores:
        raise InputError(
            f"{stack}: no slice of {MIN_PIXELS} pixels lies where {volume} shows something "
            f"(correlation {found.search_correlation:.2f}); check that both show the same brain"
        )
    return StackPrediction(
        stack=stack,
        slices=tuple(scores),
        counted_share=sum(one.n_pixels for one in scores) / n_eroded,
        search_correlation=found.search_correlation,
    )


def _simulated(data: NDArray[np.float32], slices: Slices, volume: Volume) -> NDArray[np.float32]:
    """Pixels [P] of slices, simulated from a volume."""
    return VoxelOperator(slices.planes, volume.grid, None, PSF_POINTS).forward(data).astype(np.float32)


def _eroded(mask: NDArray[np.bool_], n_pixels: int) -> NDArray[np.bool_]:
    """A mask without its rim; the edge of the array counts as outside."""
    return binary_erosion(mask, iterations=n_pixels) if n_pixels else mask
