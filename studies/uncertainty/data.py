"""Simulated subjects that calibrate and check uncertainty.nii.gz: predictors and error of each voxel."""

from __future__ import annotations

import pickle
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.images import Volume
from g3r.evaluation.align import resample
from g3r.evaluation.case import SimulatedCase
from g3r.evaluation.metrics import score
from g3r.fitting.slice_stage import SliceFit
from g3r.output.result import ReconstructionResult
from g3r.reconstruct import GaussianReconstructor
from g3r.registration import Registration
from g3r.uncertainty.estimate import UncertaintyInputs
from studies.runs import aligned
from studies.subjects import SubjectSpec, simulated_case
from studies.tables import stacks

Subject = tuple[SubjectSpec, int]
"""A subject and the number of its stacks that are used."""


def _subjects(*chosen: tuple[str, int, str, int]) -> list[Subject]:
    """Subjects from volume, number of stacks, motion and seed."""
    return [(SubjectSpec(volume=volume, motion=motion, seed=seed), n) for volume, n, motion, seed in chosen]


FIT_SUBJECTS = _subjects(
    ("spina-bifida/sb26-operated", 3, "mild", 51_200),
    ("spina-bifida/sb33-operated", 1, "mild", 51_209),
    ("spina-bifida/sb28-operated", 3, "moderate", 51_201),
    ("spina-bifida/sb25-operated", 1, "mild", 51_205),
    ("spina-bifida/sb30-operated", 3, "mild", 51_202),
    ("spina-bifida/sb27-operated", 1, "none", 51_206),
    ("spina-bifida/sb32-operated", 3, "moderate", 51_203),
    ("spina-bifida/sb29-operated", 1, "mild", 51_207),
    ("spina-bifida/sb34-operated", 3, "mild", 51_204),
    ("spina-bifida/sb31-operated", 1, "mild", 51_208),
)
"""Volume, stacks, motion and seed of the subjects that the coefficients are fitted to. No prior was
trained on these volumes (checkpoints are chosen by them)."""

CHECK_SUBJECTS = _subjects(
    ("crl-sta/sta24", 3, "mild", 52_200),
    ("crl-sta/sta30", 1, "mild", 52_201),
    ("crl-sta/sta34", 3, "moderate", 52_202),
    ("crl-sta/sta24", 1, "mild", 52_203),
    ("crl-sta/sta30", 3, "mild", 52_204),
    ("crl-sta/sta34", 1, "mild", 52_205),
    ("crl-sta/sta24", 3, "moderate", 52_206),
    ("crl-sta/sta30", 1, "none", 52_207),
    ("crl-sta/sta34", 3, "mild", 52_208),
    ("crl-sta/sta24", 1, "mild", 52_209),
)
"""Subjects that the coefficients are checked on: weeks excluded from every training and choice."""

UNREGISTERED = _subjects(("crl-sta/sta24", 3, "moderate", 52_250))[0]
"""One more of the check, reconstructed as if headers were right: does the map say that it is wrong?"""

NO_REGISTRATION = {
    "registration.template": False,
    "registration.network": False,
    "registration.stacks": False,
    "registration.segments": False,
    "registration.n_rounds": 0,
    "registration.standard_orientation": False,
}

VOXELS_PER_SUBJECT = 40_000


@dataclass(frozen=True, kw_only=True)
class Judged:
    """One reconstruction, voxel by voxel.

    Attributes:
        spec: the subject.
        n_stacks: how many of its stacks were used.
        predictors: [n] by name, a random choice of the voxels inside both masks.
        error: [n] volume minus truth, in normalised intensities.
        psnr_db: of the volume.
        median_mm: error of the poses.
        reliable: whether the record calls the registration reliable.
        registered: whether there was one.
        seconds: of reconstruction and comparison; registration comes from the cache.
        map_seconds: of the map alone, processor time.
    """

    spec: SubjectSpec
    n_stacks: int
    predictors: dict[str, NDArray[np.float64]]
    error: NDArray[np.float64]
    psnr_db: float
    median_mm: float
    reliable: bool | None
    seconds: float
    map_seconds: float
    registered: bool = True

    @property
    def label(self) -> str:
        """Subject and number of stacks."""
        name = f"{self.spec.name}, {stacks(self.n_stacks)}"
        return name if self.registered else f"{name}, not registered"


def judged(
    spec: SubjectSpec, n_stacks: int, reconstructor: GaussianReconstructor, cache: Path, *, registered: bool = True
) -> Judged:
    """Simulate, register (or take that from the cache), reconstruct and compare with the truth.

    Args:
        spec: the subject.
        n_stacks: of its stacks.
        reconstructor: with or without prior.
        cache: folder of simulated subjects and their registrations.
        registered: False reconstructs from the headers.
    """
    case = simulated_case(spec, cache)
    motion = _cached_registration(case, n_stacks, reconstructor, cache) if registered else None
    start = time.perf_counter()
    result = reconstructor.reconstruct(case.stacks[:n_stacks], motion)
    pose_error = case.pose_error(result.slices)
    alignment = aligned(case, result.volume, result.grid, pose_error.common).alignment
    assert alignment is not None
    truth_from_result = alignment.volume_from_reference.inverse() @ pose_error.common
    truth = resample(case.truth, result.grid, truth_from_result)
    mask = Volume(case.truth_mask.astype(np.float32), case.truth.affine, "mask")
    both = result.mask & (resample(mask, result.grid, truth_from_result) > 0.5)
    error = relative_error(result.volume, truth, both) / result.intensity_scale
    rng = np.random.default_rng(spec.seed)
    inside = np.flatnonzero(both[result.mask])
    chosen = np.sort(rng.choice(inside, min(VOXELS_PER_SUBJECT, len(inside)), replace=False))
    return Judged(
        spec=spec,
        n_stacks=n_stacks,
        predictors={name: one[chosen] for name, one in predictors_of(result).items()},
        error=error[result.mask][chosen],
        psnr_db=score(result.volume, truth, both).psnr_db,
        median_mm=pose_error.median_mm,
        reliable=result.record.registration is not None and result.record.registration.reliable,
        seconds=time.perf_counter() - start,
        map_seconds=result.record.cpu_seconds["uncertainty"],
        registered=registered,
    )


def relative_error(
    volume: NDArray[np.float32], truth: NDArray[np.float32], mask: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Volume minus truth, the truth brought to the volume's mean in the mask.

    One factor, since the scale of a reconstruction is arbitrary. The gain and offset that `g3r-evaluate` fits
    would hide errors: of a volume that has nothing to do with the truth they leave its mean.

    Args:
        volume: [I, J, K] of the reconstruction.
        truth: [I, J, K] on the same grid.
        mask: [I, J, K] where both are known.
    """
    factor = float(volume[mask].mean()) / float(truth[mask].mean())
    return volume.astype(np.float64) - factor * truth


def predictors_of(result: ReconstructionResult) -> dict[str, NDArray[np.float64]]:
    """Predictors of the map of a result."""
    scale = np.float32(result.intensity_scale)
    fit = SliceFit(
        cloud=result.cloud,
        slices=result.slices,
        gain=result.gain,
        weight=result.weight,
        history=[],
        bias_field=result.record.bias_field,
    )
    given = UncertaintyInputs(
        volume=result.volume / scale,
        mask=result.mask,
        grid=result.grid,
        fit=fit,
        prior=result.prior / scale,
        density=result.density,
        prior_grid=result.prior_grid,
        prior_share=result.prior_share,
    )
    return given.predictors()


def _cached_registration(
    case: SimulatedCase, n_stacks: int, reconstructor: GaussianReconstructor, cache: Path
) -> Registration:
    """Registration of the first stacks; it does not depend on the prior, so it is made once and kept."""
    path = cache / f"{case.name}-{n_stacks}.whole-slices.motion.pkl"
    if path.is_file():
        with path.open("rb") as stream:
            return pickle.load(stream)
    motion = reconstructor.register_stacks(case.stacks[:n_stacks])
    with path.open("wb") as stream:
        pickle.dump(motion, stream)
    return motion
