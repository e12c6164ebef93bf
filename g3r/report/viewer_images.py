"""Small copies of a result's images for the viewer: on one grid, cropped to the head, one or two bytes per voxel."""

from __future__ import annotations

import base64
import gzip
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import nibabel as nib
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from g3r.acquisition.images import Volume, load_volume
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import bounding_box, on_grid

Kind = Literal["grey", "map", "mark"]

REGIONS = frozenset({"mask", "unseen"})
"""Images whose union is the extent of the head."""

MAX_VOXELS = 2_500_000
"""Limit of the cropped grid. Above it, blocks of 2 x 2 x 2 voxels are averaged, so that the page stays below 10 MB."""

MARGIN_VOXELS = 3
COMPRESSION = 6


@dataclass(frozen=True, kw_only=True)
class Layer:
    """One image of the folder as the viewer shows it.

    Attributes:
        name: name of the file, without its ending.
        title: label of its button.
        caption: how to read it.
        kind: "grey" for intensities, "map" for values in colour, "mark" for an outlined part.
        top: value shown brightest; None takes the 97th percentile in the brain.
    """

    name: str
    title: str
    caption: str
    kind: Kind
    top: float | None = None


LAYERS = (
    Layer(name="volume", title="volume", caption="the reconstruction", kind="grey"),
    Layer(
        name="uncertainty",
        title="uncertainty",
        caption="expected error of each voxel, in the volume's intensities: bright is less certain",
        kind="map",
    ),
    Layer(
        name="prior_share",
        title="prior share",
        caption="what each voxel rests on: 0 the slices of this head, 1 what other brains look like",
        kind="map",
        top=1.0,
    ),
    Layer(
        name="density",
        title="coverage",
        caption="how often slices looked: 1 is one stack without gaps, below 0.2 counts as not seen",
        kind="map",
    ),
    Layer(
        name="prior",
        title="prior volume",
        caption="what the network made of the slices before the fit: compare it with the volume",
        kind="grey",
    ),
    Layer(name="unseen", title="not seen", caption="brain that no slice saw", kind="mark"),
    Layer(name="mask", title="brain outline", caption="what was taken for brain", kind="mark"),
)
"""The layers in the order of the buttons; a layer is shown if its file NAME.nii.gz is in the folder."""


@dataclass(frozen=True)
class ViewerImages:
    """The images that the page embeds.

    Attributes:
        grid: grid of all copies: RAS, cropped.
        data: name to array [I, J, K] on `grid`, in the values of the file.
        window: name to the values shown darkest and brightest.
        mask_center_mm: [3] middle of the brain, in the space of the volume.
    """

    grid: VolumeGrid
    data: dict[str, NDArray[np.float32]]
    window: dict[str, tuple[float, float]]
    mask_center_mm: NDArray[np.float64]

    @classmethod
    def load(cls, folder: Path) -> ViewerImages:
        """Read the images of an output folder.

        Raises:
            InputError: volume or mask are missing, or an image cannot be read.
        """
        volume, mask = (_canonical(load_volume(folder / f"{name}.nii.gz")) for name in ("volume", "mask"))
        found = {"volume": volume, "mask": mask}
        for layer in LAYERS:
            path = folder / f"{layer.name}.nii.gz"
            if layer.name not in found and path.is_file():
                found[layer.name] = _canonical(load_volume(path))
        everywhere = bounding_box(np.ones(volume.grid.shape, bool))
        brain = np.logical_or.reduce([_on(found[name], volume.grid, everywhere) > 0 for name in REGIONS & found.keys()])
        if not brain.any():
            brain = np.ones(brain.shape, bool)
        center = volume.grid.world(_middle(brain))
        box = bounding_box(brain, MARGIN_VOXELS)
        grid, brain = volume.grid.cropped(box), brain[box]
        cropped = {name: np.nan_to_num(_on(one, volume.grid, box)) for name, one in found.items()}
        shown_part = brain | (cropped["volume"] != 0)
        for layer in LAYERS:  # some images fill their whole grid
            if layer.name in cropped and layer.kind != "mark":
                cropped[layer.name] = cropped[layer.name] * (shown_part if layer.kind == "grey" else brain)
        while np.prod(grid.shape) > MAX_VOXELS and min(grid.shape) > 1:
            cropped, grid = {name: _joined(one) for name, one in cropped.items()}, _joined_grid(grid)
        inside = cropped["mask"] > 0.5
        return cls(grid, cropped, {one.name: _window(one, cropped, inside) for one in shown(cropped)}, center)

    def records(self) -> list[dict[str, Any]]:
        """Layers for the script of the page: title, caption, window, and a compressed NIfTI as text (base64)."""
        layers = shown(self.data)
        with ThreadPoolExecutor() as pool:  # compression takes one thread, and releases Python's lock
            packed = pool.map(self._nifti, layers)
        return [
            {
                "name": one.name,
                "title": one.title,
                "caption": one.caption,
                "kind": one.kind,
                "low": self.window[one.name][0],
                "high": self.window[one.name][1],
                "data": base64.b64encode(data).decode("ascii"),
            }
            for one, data in zip(layers, packed, strict=True)
        ]

    def _nifti(self, layer: Layer) -> bytes:
        data, (low, high) = self.data[layer.name], self.window[layer.name]
        if layer.kind == "mark":
            inside = data > 0.5
            stored, slope, zero = (inside & ~binary_erosion(inside)).astype(np.uint8), 1.0, 0.0
            if layer.name == "unseen":
                stored = inside.astype(np.uint8)
        elif layer.name == "volume":
            slope, zero = max(abs(float(data.min())), float(data.max()), 1e-9) / 4000, 0.0
            stored = np.rint(data / slope).astype(np.int16)
        else:
            slope, zero = (high - low) / 255, low
            stored = np.rint((np.clip(data, low, high) - low) / slope).astype(np.uint8)
        image = nib.Nifti1Image(stored, self.grid.affine)
        image.header.set_slope_inter(slope, zero)
        image.header.set_xyzt_units("mm")
        return gzip.compress(image.to_bytes(), COMPRESSION, mtime=0)


def shown(data: dict[str, NDArray[np.float32]]) -> list[Layer]:
    """Layers that have something to show."""
    return [one for one in LAYERS if one.name in data and (one.kind != "mark" or data[one.name].any())]


def _canonical(volume: Volume) -> Volume:
    """The same image with its axes nearest to right, anterior and superior."""
    image = nib.as_closest_canonical(nib.Nifti1Image(volume.data, volume.affine))
    return Volume(np.asarray(image.dataobj, dtype=np.float32), image.affine, volume.name)


def _on(image: Volume, grid: VolumeGrid, box: tuple[slice, ...]) -> NDArray[np.float32]:
    """An image interpolated on a box of a grid."""
    if image.data.shape == grid.shape and np.allclose(image.affine, grid.affine, atol=1e-3):
        return image.data[box]
    return on_grid(image.data, image.grid, grid.cropped(box), outside=0.0)


def _middle(brain: NDArray[np.bool_]) -> list[float]:
    """Mean index [3] of the voxels of a region."""
    sums = [brain.sum(tuple(other for other in range(3) if other != axis)) for axis in range(3)]
    return [float(np.average(np.arange(len(one)), weights=one)) for one in sums]


def _joined(data: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means of 2 x 2 x 2 voxels; an odd last layer is dropped, because it is margin."""
    i, j, k = (n // 2 for n in data.shape)
    return data[: 2 * i, : 2 * j, : 2 * k].reshape(i, 2, j, 2, k, 2).mean((1, 3, 5), dtype=np.float32)


def _joined_grid(grid: VolumeGrid) -> VolumeGrid:
    affine = grid.affine.copy()
    affine[:3, 3] = grid.world(np.full(3, 0.5))
    affine[:3, :3] *= 2
    n_i, n_j, n_k = grid.shape
    return VolumeGrid((n_i // 2, n_j // 2, n_k // 2), affine)


def _window(layer: Layer, data: dict[str, NDArray[np.float32]], inside: NDArray[np.bool_]) -> tuple[float, float]:
    """Values shown darkest and brightest."""
    if layer.kind == "mark":
        return 0.0, 1.0
    values = data[layer.name][inside] if inside.any() else data[layer.name].ravel()
    if layer.kind == "map":
        high = layer.top if layer.top is not None else float(np.percentile(values, 97))
        return 0.0, high if high > 0 else 1.0
    low, high = min(0.0, float(np.percentile(values, 0.5))), float(np.percentile(values, 99.5))
    return low, high if high > low else low + 1.0
