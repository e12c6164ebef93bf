"""Simulated subjects that calibrate and check uncertainty.nii.gz: predictors and error of each voxel."""

from __future__ import annotations

import hashlib
import pickle
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_synth.simulator import SIMULATOR_VERSION
from g3r.acquisition.images import Volume
from g3r.bench.record import machine
from g3r.evaluation.align import resample
from g3r.evaluation.case import SimulatedCase
from g3r.evaluation.metrics import score
from g3r.fitting.slice_stage import SliceFit
from g3r.output.result import ReconstructionResult
from g3r.reconstruct import GaussianReconstructor
from g3r.registration import Registration
from g3r.uncertainty.estimate import UncertaintyInputs
from studies.holes import Hole, with_holes
from studies.runs import aligned
from studies.subjects import SubjectSpec, simulated_case
from studies.tables import stacks


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A subject, the number of its stacks to use, and their holes."""

    spec: SubjectSpec
    n_stacks: int
    holes: tuple[Hole, ...] = ()

    @property
    def label(self) -> str:
        """Label in tables: name, number of stacks, and whether slices are missing."""
        missing = ", slices missing" if self.holes else ""
        return f"{self.spec.name}, {stacks(self.n_stacks)}{missing}"


def _subject(volume: str, n_stacks: int, motion: str, seed: int, *holes: Hole) -> Subject:
    return Subject(spec=SubjectSpec(volume=volume, motion=motion, seed=seed), n_stacks=n_stacks, holes=holes)


def _in_each(first: float, last: float) -> tuple[Hole, ...]:
    """The same hole in each of three stacks."""
    return tuple(Hole(stack, first, last) for stack in range(3))


FIT_SUBJECTS = [
    _subject("spina-bifida/sb26-operated", 3, "mild", 51_200),
    _subject("spina-bifida/sb33-operated", 1, "mild", 51_209, Hole(0, 0.4, n_slices=3)),
    _subject("spina-bifida/sb28-operated", 3, "moderate", 51_201, *_in_each(0.3, 0.6)),
    _subject("spina-bifida/sb25-operated", 1, "mild", 51_205),
    _subject("spina-bifida/sb30-operated", 3, "mild", 51_202),
    _subject("spina-bifida/sb27-operated", 1, "none", 51_206, Hole(0, 0.7)),
    _subject("spina-bifida/sb32-operated", 3, "moderate", 51_203),
    _subject("spina-bifida/sb29-operated", 1, "mild", 51_207),
    _subject("spina-bifida/sb34-operated", 3, "mild", 51_204, *_in_each(0.7, 1.0)),
    _subject("spina-bifida/sb31-operated", 1, "mild", 51_208, Hole(0, 0.55, n_slices=6)),
    _subject("crl-sta/sta24", 3, "mild", 51_210, *_in_each(0.3, 0.55)),
    _subject("crl-sta/sta24", 1, "mild", 51_211, Hole(0, 0.65)),
    _subject("crl-sta/sta24", 3, "moderate", 51_212, *_in_each(0.0, 0.25)),
    _subject("crl-sta/sta24", 1, "none", 51_213, Hole(0, 0.4, n_slices=5)),
]
"""Volume, stacks, motion, seed and holes of the subjects to which the coefficients are fitted. No prior was trained on
these volumes (checkpoints are chosen on operated volumes). The last four come from the atlas that makes up most of the
template, which fills their holes twice as well as those of heads with spina bifida; users have heads of both kinds."""

CHECK_SUBJECTS = [
    _subject("crl-sta/sta30", 3, "mild", 52_210),
    _subject("crl-sta/sta30", 1, "mild", 52_201, Hole(0, 0.45, n_slices=4)),
    _subject("crl-sta/sta34", 3, "moderate", 52_202, *_in_each(0.35, 0.6)),
    _subject("crl-sta/sta34", 1, "mild", 52_213, Hole(0, 0.0, 0.3)),
    _subject("crl-sta/sta30", 3, "mild", 52_204, *_in_each(0.7, 1.0)),
    _subject("crl-sta/sta34", 1, "mild", 52_205),
    _subject("crl-sta/sta30", 3, "moderate", 52_216),
    _subject("crl-sta/sta30", 1, "none", 52_207),
    _subject("crl-sta/sta34", 3, "mild", 52_208),
    _subject("crl-sta/sta30", 1, "mild", 52_219, Hole(0, 0.6, n_slices=2)),
]
"""Subjects of the check: weeks that no network was trained on. Other simulations of them were looked at."""

UNREGISTERED = _subject("crl-sta/sta30", 3, "moderate", 52_260)
"""Additional subject of the check, reconstructed from the headers without registration, to see whether the uncertainty
map shows the resulting errors."""

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
        subject: the subject.
        predictors: [n] by name, at a random choice of voxels inside both masks.
        unseen: [n] whether a voxel is unseen.
        error: [n] volume minus truth, in normalised intensities.
        psnr_db: of the volume.
        median_mm: median pose error.
        reliable: whether the record calls the registration reliable.
        registered: whether slices were registered.
        seconds: for reconstruction and comparison, without the cached registration.
        map_seconds: CPU time for the map alone.
    """

    subject: Subject
    predictors: dict[str, NDArray[np.float64]]
    unseen: NDArray[np.bool_]
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
        return self.subject.label if self.registered else f"{self.subject.label}, not registered"


def judged(subject: Subject, reconstructor: GaussianReconstructor, cache: Path, *, registered: bool = True) -> Judged:
    """Simulate, register (or take that from the cache), reconstruct and compare with the truth.

    Args:
        subject: the subject.
        reconstructor: with or without prior.
        cache: folder of simulated subjects and their registrations.
        registered: False reconstructs from the headers.
    """
    case = simulated_case(subject.spec, cache, subject.n_stacks)
    case = replace(case, stacks=with_holes(case.stacks, subject.holes))
    motion = _cached_registration(case, subject, reconstructor, cache) if registered else None
    start = time.perf_counter()
    result = reconstructor.reconstruct(case.stacks, motion)
    pose_error = case.pose_error(result.slices)
    alignment = aligned(case, result.volume, result.grid, pose_error.common).alignment
    assert alignment is not None
    truth_from_result = alignment.volume_from_reference.inverse() @ pose_error.common
    truth = resample(case.truth, result.grid, truth_from_result)
    mask = Volume(case.truth_mask.astype(np.float32), case.truth.affine, "mask")
    both = result.mask & (resample(mask, result.grid, truth_from_result) > 0.5)
    error = relative_error(result.volume, truth, both) / result.intensity_scale
    rng = np.random.default_rng(subject.spec.seed)
    inside = np.flatnonzero(both[result.mask])
    chosen = np.sort(rng.choice(inside, min(VOXELS_PER_SUBJECT, len(inside)), replace=False))
    return Judged(
        subject=subject,
        predictors={name: one[chosen] for name, one in predictors_of(result).items()},
        unseen=result.unseen[result.mask][chosen],
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
    """Volume minus truth, with the truth scaled to the volume's mean in the mask.

    A single factor is used because the scale of a reconstruction is arbitrary. The gain and offset that `g3r-evaluate`
    fits would hide errors: they reduce a volume that is unrelated to the truth to its mean.

    Args:
        volume: [I, J, K] of the reconstruction.
        truth: [I, J, K] on the same grid.
        mask: [I, J, K] voxels where both are known.
    """
    factor = float(volume[mask].mean()) / float(truth[mask].mean())
    return volume.astype(np.float64) - factor * truth


def predictors_of(result: ReconstructionResult) -> dict[str, NDArray[np.float64]]:
    """Predictors of the uncertainty map of a result."""
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
    case: SimulatedCase, subject: Subject, reconstructor: GaussianReconstructor, cache: Path
) -> Registration:
    """Registration of the stacks; it does not depend on the prior, so it is made once for a commit and kept."""
    missing = "".join(f"-{h.stack}_{h.first:g}_{h.n_slices or h.last:g}" for h in subject.holes)
    made_with = f"{machine()['commit']} {SIMULATOR_VERSION} {reconstructor.settings.registration}"
    key = hashlib.sha256(made_with.encode()).hexdigest()[:12]
    path = cache / f"{case.name}-{subject.n_stacks}{missing}.{key}.motion.pkl"
    if path.is_file():
        with path.open("rb") as stream:
            return pickle.load(stream)
    motion = reconstructor.register_stacks(case.stacks)
    with path.open("wb") as stream:
        pickle.dump(motion, stream)
    return motion
