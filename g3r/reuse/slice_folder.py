"""Slices as a folder of single images whose headers hold the poses, as NeSVoR reads and writes them.

`N.nii.gz` is a slice, one voxel thick, and `mask_N.nii.gz` its mask. The affine holds the estimated pose, and the
voxel size of the third axis is the slice thickness.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.images import Space, save_volume
from g3r.acquisition.planes import Slices
from g3r.gaussians import render
from g3r.reuse.finished_run import FinishedRun


def slice_affines(slices: Slices) -> NDArray[np.float64]:
    """Affines [K, 4, 4] (world RAS mm from voxel) of slices as single images, right-handed."""
    planes = slices.planes
    spacing = np.column_stack([planes.spacing_mm, slices.thickness_mm])
    affine = np.tile(np.eye(4), (len(slices), 1, 1))
    affine[:, :3, :3] = planes.rotation * spacing[:, None, :]
    middle = np.column_stack([(planes.shape - 1) / 2, np.zeros(len(slices))])
    affine[:, :3, 3] = planes.center_mm - np.einsum("kij,kj->ki", affine[:, :3, :3], middle)
    return affine


def simulated_slices(run: FinishedRun) -> NDArray[np.float32]:
    """Pixels [P] of the run's slices as predicted by the Gaussians, in the stacks' intensities.

    Rendered through the PSF and times the slice's gain, in the final poses; without bias field, V_prior and noise.
    """
    found, planes = run.geometry, run.geometry.slices.planes
    pixels = render(run.cloud, planes, cutoff_sigma=run.record.settings.slice_stage.cutoff_sigma).numpy()
    gain = (found.gain * found.intensity_scale).astype(np.float32)
    return np.asarray(pixels * gain[planes.plane_id()], dtype=np.float32)


def write_slices(folder: Path, slices: Slices, space: Space) -> None:
    """Write each slice and its mask; pixels outside the mask are zero.

    Args:
        folder: existing folder.
        slices: [K] in their poses, with their pixels.
        space: space of the poses.

    Raises:
        InputError: the folder cannot be written.
    """
    affine, planes = slice_affines(slices), slices.planes
    for k in range(len(slices)):
        pixels = slice(int(planes.offset[k]), int(planes.offset[k + 1]))
        shape = (*map(int, planes.shape[k]), 1)
        inside = slices.mask[pixels].reshape(shape)
        image = slices.value[pixels].reshape(shape) * inside
        save_volume(folder / f"{k}.nii.gz", image, affine[k], space=space)
        save_volume(folder / f"mask_{k}.nii.gz", inside, affine[k], space=space)
