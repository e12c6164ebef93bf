"""The cloud of 3D Gaussians that represents the head, without optimiser state and without appearance models."""

from __future__ import annotations

import io
import os
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from g3r.errors import InputError
from g3r.run.atomic_file import atomic_path
from g3r.run.on_demand import is_tensor, torch

if TYPE_CHECKING:
    from torch import Tensor

SIGMA_RANGE_MM = (1e-6, 1e6)
"""Allowed sigma: no structure of a head is outside, where the kernels' integers and float32 overflow."""

MAX_LOG_SCALE = 13.816
"""Logarithm of the largest sigma, and of one over the smallest."""

MIN_QUATERNION = 1e-15
"""Length below which a quaternion has no direction; gradients grow as one over the length."""


@dataclass(frozen=True, kw_only=True)
class GaussianCloud:
    """V(x) = sum_j c_j exp(-(x - mu_j)^T Sigma_j^-1 (x - mu_j) / 2), Sigma = R diag(s^2) R^T (G3R Eq. 3).

    Args:
        mean_mm: [N, 3] centres relative to the origin.
        log_scale: [N, 3] natural logarithm of the standard deviations in mm.
        quaternion_wxyz: [N, 4] orientation; normalised on use, must not be near zero.
        amplitude: [N] c_j, height without any PSF; may be negative.
        origin_mm: [3] float64 world position of the local origin. Centres are kept relative to it so that
            float32 loses no digits when the scanner's origin is far away.

    Raises:
        ValueError: shapes that do not belong together, values that are not finite, a sigma outside
            `SIGMA_RANGE_MM`, or a quaternion of (nearly) no length.
    """

    mean_mm: Tensor
    log_scale: Tensor
    quaternion_wxyz: Tensor
    amplitude: Tensor
    origin_mm: NDArray[np.float64]

    def __post_init__(self) -> None:
        n = len(self.mean_mm)
        for name, shape in (
            ("mean_mm", (n, 3)),
            ("log_scale", (n, 3)),
            ("quaternion_wxyz", (n, 4)),
            ("amplitude", (n,)),
        ):
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"{name} has shape {found}; expected {shape}")
            if n and not bool(torch.isfinite(getattr(self, name)).all()):
                raise ValueError(f"{name} holds values that are not finite")
        object.__setattr__(self, "origin_mm", np.array(self.origin_mm, dtype=np.float64).reshape(3))
        if not np.isfinite(self.origin_mm).all():
            raise ValueError("origin_mm holds values that are not finite")
        if n and float(self.log_scale.detach().abs().max()) > MAX_LOG_SCALE:
            low, high = SIGMA_RANGE_MM
            raise ValueError(f"a sigma is out of range; expected {low:g} to {high:g} mm")
        if n and float(self.quaternion_wxyz.detach().double().norm(dim=1).min()) < MIN_QUATERNION:
            raise ValueError(f"a quaternion is shorter than {MIN_QUATERNION:g}; expected about one")

    @classmethod
    def of(cls, parameters: Sequence[Tensor], origin_mm: NDArray[np.float64]) -> GaussianCloud:
        """A cloud from the four tensors in the order of `parameters`."""
        names = ("mean_mm", "log_scale", "quaternion_wxyz", "amplitude")
        return cls(**dict(zip(names, parameters, strict=True)), origin_mm=origin_mm)

    def __len__(self) -> int:
        return len(self.mean_mm)

    def __repr__(self) -> str:
        origin = ", ".join(f"{x:.1f}" for x in self.origin_mm)
        return f"GaussianCloud({len(self)} Gaussians about ({origin}) mm)"

    @classmethod
    def empty(cls) -> GaussianCloud:
        """No Gaussians, and no torch: the arrays are NumPy's."""
        arrays: list[Any] = [np.zeros(shape, np.float32) for shape in ((0, 3), (0, 3), (0, 4), (0,))]
        return cls.of(arrays, np.zeros(3))

    @property
    def parameters(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Centres, log-scales, quaternions, amplitudes."""
        return self.mean_mm, self.log_scale, self.quaternion_wxyz, self.amplitude

    def take(self, index: Tensor) -> GaussianCloud:
        """The Gaussians at an index tensor or mask."""
        return GaussianCloud.of([p[index] for p in self.parameters], self.origin_mm)

    def detach(self) -> GaussianCloud:
        """The same values without a graph."""
        return GaussianCloud.of([p.detach() for p in self.parameters], self.origin_mm)

    def double(self) -> GaussianCloud:
        """The same cloud in float64."""
        return GaussianCloud.of([p.double() for p in self.parameters], self.origin_mm)

    def with_amplitude(self, amplitude: Tensor) -> GaussianCloud:
        """The same shapes with other heights."""
        return replace(self, amplitude=amplitude)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an .npz with float32 arrays named like the fields, whole or not at all.

        Raises:
            OSError: the file cannot be written.
        """
        arrays = {
            name: (one.detach().cpu().numpy() if is_tensor(one := getattr(self, name)) else one).astype(np.float32)
            for name in ("mean_mm", "log_scale", "quaternion_wxyz", "amplitude")
        }
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays, origin_mm=self.origin_mm)
        with atomic_path(path) as temporary:
            temporary.write_bytes(buffer.getvalue())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> GaussianCloud:
        """Read what `save` wrote.

        Raises:
            InputError: not such a file.
        """
        try:
            with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as data:
                names = ("mean_mm", "log_scale", "quaternion_wxyz", "amplitude")
                return cls.of([torch.from_numpy(data[name]) for name in names], data["origin_mm"])
        except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
            raise InputError(f"{path}: not a cloud written by g3r ({error}); expected the file of g3r-infer") from None
