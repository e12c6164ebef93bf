"""Quality of a result on a simulated subject: PSNR and SSIM after alignment, error of the poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.images import Volume, load_volume
from g3r.acquisition.planes import volume_from_pixels, volume_planes
from g3r.evaluation.case import SimulatedCase
from g3r.evaluation.compare import compare
from g3r.evaluation.metrics import score
from g3r.evaluation.pose_error import PoseTable, read_poses, target_registration_error
from g3r.gaussians import GaussianCloud, render
from g3r.geometry import RigidPose, VolumeGrid


@dataclass(frozen=True)
class Quality:
    """Scores of a volume and its poses.

    Attributes:
        psnr_db, ssim: scores of the volume in the truth's mask, after one rigid motion and an affine fit of the
            intensities, as `g3r-evaluate --align` scores.
        tre_mm: median over slices of their TRE.
        remaining: motion of the volume that alignment finds after the slices' common motion is removed; maps
            the truth to the volume.
    """

    psnr_db: float
    ssim: float
    tre_mm: float
    remaining: RigidPose

    def record(self) -> dict[str, float]:
        """The scores, rounded."""
        return {"psnr_db": round(self.psnr_db, 3), "ssim": round(self.ssim, 4), "tre_mm": round(self.tre_mm, 3)}


def quality(case: SimulatedCase, data: NDArray[np.float32], affine: NDArray[np.float64], poses: PoseTable) -> Quality:
    """Score a volume [I, J, K] and the slices' poses.

    The common motion of the slices is applied first, because the volume may be oriented too differently from the
    truth for alignment.

    Args:
        case: has the truth.
        data: [I, J, K] reconstructed volume.
        affine: [4, 4], world (RAS+, mm) from index.
        poses: reconstructed poses of the slices.
    """
    error = target_registration_error(case.points_mm, case.true, poses)
    grid = VolumeGrid(data.shape, affine).moved(error.common)
    comparison = compare(Volume(data, grid.affine, case.name), case.truth, case.truth_mask, align=True)
    assert comparison.alignment is not None
    scores = comparison.scores
    return Quality(scores.psnr_db, scores.ssim, error.median_mm, comparison.alignment.volume_from_reference)


def quality_of_folder(case: SimulatedCase, folder: Path) -> Quality:
    """Score the output folder of g3r-infer."""
    volume = load_volume(folder / "volume.nii.gz")
    return quality(case, volume.data, volume.affine, read_poses(folder / "slices.tsv"))


def cloud_psnr_db(
    case: SimulatedCase, cloud: GaussianCloud, poses: PoseTable, remaining: RigidPose, cutoff_sigma: float
) -> float:
    """PSNR of a cloud during a fit, rendered on the grid of the truth.

    Poses drift together with the volume during a fit, so the slices' common motion at that moment is removed, and then
    the motion that alignment found at the end.

    Args:
        case: has the truth.
        cloud: Gaussians in the frame of the poses.
        poses: poses at the same moment.
        remaining: see `Quality`.
        cutoff_sigma: see `render`.
    """
    common = target_registration_error(case.points_mm, case.true, poses).common
    planes = volume_planes(case.truth.grid).moved(common.inverse() @ remaining)
    pixels = render(cloud, planes, cutoff_sigma=cutoff_sigma).numpy()
    volume = volume_from_pixels(pixels, case.truth.grid)
    return float(score(volume, case.truth.data, case.truth_mask).psnr_db)
