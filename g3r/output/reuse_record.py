"""reuse.npz: numbers of a finished run that its images and tables hold only rounded, or not at all."""

from __future__ import annotations

import io
import math
import os
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.file_axes import FileAxes
from g3r.acquisition.planes import Planes, Slices
from g3r.acquisition.stacks import Stack
from g3r.errors import InputError
from g3r.geometry import RigidPose, VolumeGrid
from g3r.run.atomic_file import atomic_path

PLANE_FIELDS = ("rotation", "center_mm", "spacing_mm", "shape", "psf_var_mm2")


@dataclass(frozen=True)
class StackGrid:
    """The voxels of a stack.

    Attributes:
        grid: grid with the slices along the third axis.
        axes: how arrays of the file become arrays on the grid.
    """

    grid: VolumeGrid
    axes: FileAxes

    @classmethod
    def of(cls, stack: Stack) -> StackGrid:
        """The voxels of a stack that was read."""
        return cls(stack.header_grid, stack.axes)

    def in_file(self) -> VolumeGrid:
        """The grid with the axes of the file."""
        return self.axes.grid_to_file(self.grid)


@dataclass(frozen=True, kw_only=True)
class ReuseRecord:
    """Exact geometry of a result, and the correction of its volume; without pixels.

    Attributes:
        grid: grid of the volume.
        support: [I, J, K] on `grid`, where Gaussians were fitted.
        edge: [I, J, K] on `grid`, how much of the volume is shown, see `Mixture`.
        prior_grid: grid of V_prior, density and correction.
        correction: [I, J, K] on `prior_grid`, see `Mixture`; None without one.
        intensity_scale: intensity in the stacks of a 1 in the fit.
        stacks: one per stack.
        slices: [K] in their final poses, with their masks and the PSF of the fit; all values are zero.
        gain, weight: [K] intensity factor and weight of each slice.
    """

    grid: VolumeGrid
    support: NDArray[np.bool_]
    edge: NDArray[np.float16]
    prior_grid: VolumeGrid
    correction: NDArray[np.float16] | None = None
    intensity_scale: float
    stacks: tuple[StackGrid, ...]
    slices: Slices
    gain: NDArray[np.float64]
    weight: NDArray[np.float64]

    def first_pixel(self) -> NDArray[np.int64]:
        """Index [K, 2] of each slice's first pixel in its stack, because slices are cropped to their masks."""
        header, half = self.slices.header_pose.translation_mm, (self.slices.planes.shape - 1) / 2
        middle = [self.stacks[s].grid.index(header[k])[:2] for k, s in enumerate(self.slices.stack_id)]
        return np.rint(np.reshape(middle, (-1, 2)) - half).astype(np.int64)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the .npz, whole or not at all; masks as bits.

        Raises:
            OSError: the file cannot be written.
        """
        slices, header = self.slices, self.slices.header_pose
        arrays: dict[str, Any] = {
            "grid_shape": np.array(self.grid.shape),
            "grid_affine": self.grid.affine,
            "support": np.packbits(self.support),
            "edge": self.edge,
            "prior_grid_shape": np.array(self.prior_grid.shape),
            "prior_grid_affine": self.prior_grid.affine,
            "intensity_scale": np.float64(self.intensity_scale),
            "stack_shape": np.array([one.grid.shape for one in self.stacks]).reshape(-1, 3),
            "stack_affine": np.array([one.grid.affine for one in self.stacks]).reshape(-1, 4, 4),
            "stack_slice_axis": np.array([one.axes.slice_axis for one in self.stacks], dtype=np.int64),
            "stack_flipped": np.array([one.axes.flipped for one in self.stacks], dtype=bool).reshape(-1, 2),
            "stack_id": slices.stack_id,
            "slice_index": slices.slice_index,
            "thickness_mm": slices.thickness_mm,
            "mask": np.packbits(slices.mask),
            "header_rotation": header.rotation,
            "header_center_mm": header.translation_mm,
            "gain": self.gain,
            "weight": self.weight,
        }
        arrays |= {name: getattr(slices.planes, name) for name in PLANE_FIELDS}
        if self.correction is not None:
            arrays["correction"] = self.correction
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        with atomic_path(path) as temporary:
            temporary.write_bytes(buffer.getvalue())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> ReuseRecord:
        """Read what `save` wrote.

        Raises:
            InputError: it is not such a file.
        """
        try:
            with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as data:
                return _record({name: data[name] for name in data.files})
        except FileNotFoundError:
            raise InputError(
                f"{path}: no such file; pass the output folder of a g3r-infer that writes it, or run that again"
            ) from None
        except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
            raise InputError(f"{path}: was not written by g3r ({error}); run g3r-infer again") from None


def _record(data: dict[str, NDArray[Any]]) -> ReuseRecord:
    planes = Planes(**{name: data[name] for name in PLANE_FIELDS})
    grid = _grid(data["grid_shape"], data["grid_affine"])
    slices = Slices(
        planes=planes,
        value=np.zeros(planes.n_pixels, np.float32),
        mask=_bits(data["mask"], planes.n_pixels),
        header_pose=RigidPose(data["header_rotation"], data["header_center_mm"]),
        stack_id=data["stack_id"],
        slice_index=data["slice_index"],
        thickness_mm=data["thickness_mm"],
    )
    turned = zip(data["stack_slice_axis"], data["stack_flipped"], strict=True)
    axes = [FileAxes(int(axis), (bool(first), bool(second))) for axis, (first, second) in turned]
    stacks = zip(data["stack_shape"], data["stack_affine"], axes, strict=True)
    prior_grid = _grid(data["prior_grid_shape"], data["prior_grid_affine"])
    if data["edge"].shape != grid.shape:
        raise ValueError(f"an edge of {data['edge'].shape} voxels; expected {grid.shape}")
    correction = data.get("correction")
    if correction is not None and correction.shape != prior_grid.shape:
        raise ValueError(f"a correction of {correction.shape} voxels; expected {prior_grid.shape}")
    return ReuseRecord(
        grid=grid,
        support=_bits(data["support"], math.prod(grid.shape)).reshape(grid.shape),
        edge=data["edge"],
        prior_grid=prior_grid,
        correction=correction,
        intensity_scale=float(data["intensity_scale"]),
        stacks=tuple(StackGrid(_grid(shape, affine), one) for shape, affine, one in stacks),
        slices=slices,
        gain=data["gain"],
        weight=data["weight"],
    )


def _grid(shape: NDArray[Any], affine: NDArray[Any]) -> VolumeGrid:
    n_i, n_j, n_k = (int(n) for n in shape)
    return VolumeGrid((n_i, n_j, n_k), affine)


def _bits(packed: NDArray[Any], count: int) -> NDArray[np.bool_]:
    """Unpack `count` booleans from bits.

    Raises:
        ValueError: another number of bits.
    """
    if len(packed) != -(-count // 8):
        raise ValueError(f"a mask has {8 * len(packed)} bits; expected {count}")
    return np.unpackbits(packed, count=count).astype(bool)
