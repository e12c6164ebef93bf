"""Which Gaussians may touch which planes: a list that stays valid for several optimiser steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Planes
from g3r.gaussians import kernels
from g3r.gaussians.cloud import GaussianCloud


@dataclass(frozen=True)
class PairList:
    """Gaussians of plane k: `gaussian[start[k] : start[k + 1]]`, ascending."""

    start: NDArray[np.int64]
    gaussian: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.gaussian)


def find_pairs(cloud: GaussianCloud, planes: Planes, cutoff_sigma: float) -> PairList:
    """All pairs whose ellipsoid at the cut-off may meet the plane's rectangle.

    Pass a larger cut-off than the renderer's to keep the list valid while Gaussians and poses move a little:
    pairs that no longer touch cost a set-up and no pixels.
    """
    arrays = CloudArrays.of(cloud)
    center = planes.center_mm - cloud.origin_mm
    chosen = np.empty(len(cloud), np.int32)
    start = np.zeros(len(planes) + 1, np.int64)
    lists = []
    half = (planes.shape - 1) / 2 * planes.spacing_mm
    for k in range(len(planes)):
        n = kernels.pair_mask(
            arrays.mean, arrays.covariance, planes.rotation[k], center[k], planes.psf_var_mm2[k],
            half[k, 0], half[k, 1], cutoff_sigma**2, chosen,
        )  # fmt: skip
        lists.append(chosen[:n].copy())
        start[k + 1] = start[k] + n
    return PairList(start, np.concatenate(lists) if lists else np.zeros(0, np.int32))


@dataclass(frozen=True)
class CloudArrays:
    """What the kernels read of a cloud: float64 centres [N, 3], covariances [N, 6], ln(s1 s2 s3), peaks."""

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    log_volume: NDArray[np.float64]
    peak: NDArray[np.float32]
    log_scale: NDArray[np.floating]
    quaternion: NDArray[np.floating]

    @classmethod
    def of(cls, cloud: GaussianCloud) -> CloudArrays:
        """Views and derived arrays of a cloud on the CPU."""
        mean, log_scale, quaternion, peak = (
            np.ascontiguousarray(p.detach().numpy()) for p in cloud.parameters
        )
        covariance, log_volume = np.empty((len(mean), 6)), np.empty(len(mean))
        kernels.covariances(log_scale, quaternion, covariance, log_volume)
        return cls(
            mean.astype(np.float64), covariance, log_volume, peak.astype(np.float32), log_scale, quaternion
        )
