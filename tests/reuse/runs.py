"""Quick runs of the small subject, and its truth."""

from __future__ import annotations

from pathlib import Path

import nibabel as nib
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from g3r.acquisition.images import Volume, load_volume, save_volume
from g3r.cli.infer import main
from g3r.evaluation.pose_error import read_poses, slice_points, target_registration_error
from g3r.geometry import RigidPose, VolumeGrid
from tests.cli.test_infer import files, inputs

QUICK = ("--preset", "fast", "--thickness", "4", "--threads", "1", "--quiet")


def reconstruct(subject: Path, folder: Path, *further: str) -> None:
    """Run g3r-infer on the subject."""
    resolution = () if "--resolution" in further else ("--resolution", "1.2")
    assert main([*map(str, inputs(subject)), *QUICK, *resolution, *further, "--output", str(folder)]) == 0


def read(path: Path) -> NDArray[np.float32]:
    """Voxels of a NIfTI file."""
    return load_volume(path).data


def truth_from_run(subject: Path, finished: Path) -> RigidPose:
    """The motion from the run's space to the truth's, by the true poses."""
    points = slice_points(files(subject, "mask"))
    return target_registration_error(
        points, read_poses(subject / "poses.tsv"), read_poses(finished / "slices.tsv")
    ).common


def truth_on(grid: VolumeGrid, subject: Path, finished: Path, truth: Path) -> NDArray[np.float32]:
    """A true label map [I, J, K] on a grid of the run's space, nearest neighbours."""
    return _sampled(load_volume(truth), truth_from_run(subject, finished), grid)


def label_truth(subject: Path, path: Path) -> Path:
    """Write a true label map: left and right half of the brain, and a ball in it."""
    mask = load_volume(subject / "truth-mask.nii.gz")
    world = mask.grid.world(np.argwhere(np.ones(mask.data.shape))).reshape(*mask.data.shape, 3)
    middle = world[mask.data > 0].mean(0)
    labels = np.where(world[..., 0] < middle[0], 1, 2)
    labels[np.linalg.norm(world - middle, axis=-1) < 9] = 7
    save_volume(path, (labels * (mask.data > 0)).astype(np.int16), mask.affine)
    return path


def label_stacks(subject: Path, truth: Path, folder: Path) -> list[Path]:
    """Label maps on the grids of the stacks, sampled at the slice centres by the true poses."""
    labels, table = load_volume(truth), read_poses(subject / "poses.tsv")
    paths = []
    for n, stack in enumerate(files(subject, "stack")):
        like = nib.Nifti1Image.from_filename(stack)
        image = np.zeros(like.shape, np.int16)
        for row, (stack_id, k) in enumerate(table.keys):
            if stack_id == n:
                affine = like.affine.copy()
                affine[:3, 3] = nib.affines.apply_affine(like.affine, [0, 0, k])
                plane = VolumeGrid((like.shape[0], like.shape[1], 1), affine)
                image[:, :, k] = _sampled(labels, table.pose.take([row]), plane)[:, :, 0]
        paths.append(folder / f"labels-{n}.nii.gz")
        nib.save(nib.Nifti1Image(image, like.affine), paths[-1])
    return paths


def _sampled(volume: Volume, pose: RigidPose, grid: VolumeGrid) -> NDArray[np.float32]:
    """Nearest-neighbour values of a volume at the points of a grid after a motion."""
    points = pose.apply(grid.world(np.argwhere(np.ones(grid.shape)))[None])[0]
    return map_coordinates(volume.data, volume.grid.index(points).T, order=0).reshape(grid.shape)


def dice(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    """Overlap of two regions, 0 to 1."""
    return float(2 * (first & second).sum() / (first.sum() + second.sum()))
