"""Synthetic lesions in an atlas volume (spheres, an enlarged ventricle), and the share of them that is kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import nibabel as nib
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, uniform_filter

from data_synth.atlas import TruthVolume, cropped
from g3r.acquisition.images import load_volume
from g3r.errors import InputError
from g3r.geometry import VolumeGrid

DIAMETER_MM = 6.0
BRIGHT_LEVEL, DARK_LEVEL = 1.0, 0.15
"""Intensity of the spheres; 1 is the 99.5th percentile in the mask, about that of fluid."""

MIN_CONTRAST = 0.35
"""Least difference between a sphere and the mean of the tissue that it replaces, in the same unit."""

MIN_DEPTH_MM = 7.0
"""Least depth of a sphere's centre below the rim of the mask, so that the sphere and its surroundings are brain."""

APART_MM = 16.0
"""Least distance between the centres of two spheres, and of a sphere and the changed ventricle."""

VENTRICLE_LABEL = 2
"""Label of the lateral ventricles in the atlases' label maps (bright; ventriculomegaly enlarges them)."""

VENTRICLE_GROWTH_MM = 4.0
"""Outward shift of the wall of one lateral ventricle: 4 mm on each side widens it from under 10 mm (normal) to over
15 mm (severe)."""

AROUND_MM = 4.0
"""Margin around a lesion that is evaluated with it, because blur spreads the lesion."""


@dataclass(frozen=True)
class Lesion:
    """One change of a volume.

    Args:
        kind: bright, dark or ventricle.
        change: [I, J, K] difference to the healthy volume.
        where: [I, J, K] bool, the changed voxels and their surroundings.
        center_mm: its centre, in the world of the volume.
    """

    kind: str
    change: NDArray[np.float32]
    where: NDArray[np.bool_]
    center_mm: NDArray[np.float64]


def kept(change_found: NDArray[np.floating], lesion: Lesion) -> float:
    """Share of a lesion's contrast that a reconstruction keeps.

    It is the least-squares factor of the true change in the change of the reconstruction, after subtraction of their
    means over the lesion and its surroundings: 1 for the truth, 0 for a reconstruction that does not show the lesion.

    Args:
        change_found: [I, J, K] reconstruction with the lesion minus the one without, on the lesion's grid.
        lesion: the true change.
    """
    true = lesion.change[lesion.where].astype(np.float64)
    found = np.asarray(change_found)[lesion.where].astype(np.float64)
    true -= true.mean()
    return float((true * (found - found.mean())).sum() / (true**2).sum())


def load_labels(volume_file: Path, mask_file: Path, margin_voxels: int) -> TruthVolume:
    """Load the label map of an atlas volume, reoriented and cropped like the volume itself.

    Args:
        volume_file: of the atlas volume; the label map is in the same folder.
        mask_file: its brain mask.
        margin_voxels: kept around the mask.

    Raises:
        InputError: no label map.
    """
    path = volume_file.with_name("labels.nii.gz")
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected the label map of {volume_file.name}")
    labels, mask = load_volume(path), load_volume(mask_file)
    turn = nib.orientations.io_orientation(labels.affine)
    affine = labels.affine @ nib.orientations.inv_ornt_aff(turn, labels.data.shape)
    data, inside = (nib.orientations.apply_orientation(one.data, turn) for one in (labels, mask))
    return cropped(
        TruthVolume(name="labels", data=np.asarray(data, np.float32), mask=inside > 0.5, affine=affine), margin_voxels
    )


def draw_lesions(
    truth: TruthVolume, labels: NDArray[np.floating], bright: float, rng: np.random.Generator, n_of_each: int = 2
) -> list[Lesion]:
    """Random lesions of a head: an enlarged ventricle and spheres.

    Args:
        truth: the healthy head.
        labels: [I, J, K] on its grid.
        bright: the intensity that counts as 1.
        rng: draws the side of the ventricle and the positions.
        n_of_each: number of bright spheres, and of dark spheres.

    Raises:
        InputError: the head has no room for them.
    """
    grid = VolumeGrid(truth.data.shape, truth.affine)
    lesions = [_ventricle(truth, labels, grid, rng)]
    spacing = grid.spacing_mm
    depth = distance_transform_edt(np.pad(truth.mask, 1), sampling=spacing)[1:-1, 1:-1, 1:-1]
    free = (depth > MIN_DEPTH_MM) & ~(labels == VENTRICLE_LABEL)
    free &= distance_transform_edt(lesions[0].change == 0, sampling=spacing) > APART_MM / 2
    width = np.maximum(np.round(DIAMETER_MM / spacing).astype(int), 1)
    mean = uniform_filter(truth.data / np.float32(bright), width.tolist())
    # bright spheres first, because they need dark tissue, which is rarer deep in the head than bright tissue
    for kind, level in (("bright", BRIGHT_LEVEL), ("dark", DARK_LEVEL)):
        for _ in range(n_of_each):
            contrast = (level - mean) if kind == "bright" else (mean - level)
            places = np.argwhere(free & (contrast > MIN_CONTRAST))
            if len(places) == 0:
                raise InputError(f"{truth.name}: no room for a {kind} sphere of {DIAMETER_MM:g} mm; use fewer lesions")
            center = grid.world(places[rng.integers(len(places))])
            one = _sphere(truth, grid, center, kind, level * bright)
            lesions.append(one)
            away = np.linalg.norm(_positions(grid) - center, axis=-1)
            free &= away > APART_MM
    return lesions


def with_lesions(truth: TruthVolume, lesions: Sequence[Lesion]) -> TruthVolume:
    """The head with its lesions, which do not overlap, so that their changes add up."""
    return replace(truth, data=truth.data + sum((one.change for one in lesions), np.zeros((), np.float32)))


def _sphere(truth: TruthVolume, grid: VolumeGrid, center_mm: NDArray[np.float64], kind: str, level: float) -> Lesion:
    """A sphere of uniform intensity with a surface softened over one voxel (partial volume)."""
    distance = np.linalg.norm(_positions(grid) - center_mm, axis=-1)
    covered = np.clip((DIAMETER_MM / 2 - distance) / grid.spacing_mm.mean() + 0.5, 0, 1)
    change = (covered * (level - truth.data)).astype(np.float32)
    return Lesion(kind, change, (distance < DIAMETER_MM / 2 + AROUND_MM) & truth.mask, center_mm)


def _ventricle(truth: TruthVolume, labels: NDArray[np.floating], grid: VolumeGrid, rng: np.random.Generator) -> Lesion:
    """One lateral ventricle, enlarged by an outward shift of its wall and filled with its own fluid intensity."""
    both = labels == VENTRICLE_LABEL
    if not both.any():
        raise InputError(f"{truth.name}: the label map has no ventricle (label {VENTRICLE_LABEL})")
    # the first axis of canonical volumes runs from left to right
    across = np.arange(labels.shape[0])[:, None, None] - np.argwhere(both)[:, 0].mean()
    fluid = both & ((across if rng.integers(2) else -across) > 0)
    beyond = distance_transform_edt(~fluid, sampling=grid.spacing_mm)
    grown = np.clip((VENTRICLE_GROWTH_MM - beyond) / grid.spacing_mm.mean() + 0.5, 0, 1)
    # the fluid must reach neither the rim of the head nor across the midline
    inner = distance_transform_edt(truth.mask, sampling=grid.spacing_mm)
    grown = np.where(inner > MIN_DEPTH_MM / 2, grown, 0)
    core = fluid & (distance_transform_edt(fluid, sampling=grid.spacing_mm) > grid.spacing_mm.mean())
    level = float(np.percentile(truth.data[core if core.any() else fluid], 75))
    smooth = gaussian_filter(np.maximum(grown, fluid).astype(np.float32), 0.6)
    change = (np.where(truth.mask, smooth, 0) * np.maximum(level - truth.data, 0)).astype(np.float32)
    where = distance_transform_edt(np.abs(change) < 0.02 * level, sampling=grid.spacing_mm) < AROUND_MM
    middle = grid.world(np.argwhere(fluid).mean(0))
    return Lesion("ventricle", change, where & truth.mask, middle)


def _positions(grid: VolumeGrid) -> NDArray[np.float64]:
    return grid.world(np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), -1))
