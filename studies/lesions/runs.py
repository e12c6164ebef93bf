"""Reconstruction of one head with and without its lesions, from the same slices, and the share kept of each lesion."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_synth.atlas import TruthVolume, cropped, find_subjects, load_subject
from data_synth.simulator import SimulatedStack, orthogonal_settings, simulate_stacks
from g3r.acquisition.images import Volume
from g3r.acquisition.slicing import slices_from_stacks
from g3r.evaluation.align import resample
from g3r.geometry import VolumeGrid
from g3r.geometry.rigid import RigidPose
from g3r.output.result import ReconstructionResult
from g3r.reconstruct import GaussianReconstructor
from g3r.registration import Registration
from studies.lesions.volumes import Lesion, draw_lesions, kept, load_labels, with_lesions
from studies.subjects import BRIGHT, SubjectSpec, stretched

MARGIN_VOXELS = 4
MOTION = "mild"
DROPOUT_WEIGHT = 0.05
"""Weight of a slice that lost its signal, as registration would give it."""


@dataclass(frozen=True)
class LesionSubject:
    """A head, its lesions, and three stacks with and without them, with the same motion, gains and noise."""

    name: str
    healthy: TruthVolume
    lesions: tuple[Lesion, ...]
    stacks: Mapping[str, list[SimulatedStack]]

    @property
    def grid(self) -> VolumeGrid:
        """Grid of the truth and the lesions."""
        return VolumeGrid(self.healthy.data.shape, self.healthy.affine)


@dataclass(frozen=True, kw_only=True)
class LesionRun:
    """Result of one head with one number of stacks.

    Attributes:
        subject: the head.
        n_stacks: number of its stacks that were used.
        volumes: variant -> reconstruction with lesions [I, J, K], on the truth's grid and in its intensities.
        kept: variant -> share of the contrast of each lesion that is kept.
        seconds: of all reconstructions.
    """

    subject: LesionSubject
    n_stacks: int
    volumes: dict[str, NDArray[np.float32]]
    kept: dict[str, list[float]]
    seconds: float

    def rows(self) -> list[dict[str, Any]]:
        """A row for each lesion."""
        return [
            {
                "subject": self.subject.name,
                "n_stacks": self.n_stacks,
                "kind": lesion.kind,
                "kept": {variant: shares[k] for variant, shares in self.kept.items()},
            }
            for k, lesion in enumerate(self.subject.lesions)
        ]


def lesion_subject(volume: str, seed: int, atlas: Path) -> LesionSubject:
    """A stretched head of the atlas with random lesions, sliced with and without them.

    Args:
        volume: name of the atlas subject.
        seed: of stretch, lesions and slices.
        atlas: folder of the atlas.

    Raises:
        InputError: the atlas lacks the volume or its label map.
    """
    chosen = find_subjects(atlas, include=[volume])[0]
    spec = SubjectSpec(volume=volume, motion=MOTION, seed=seed)
    head = cropped(load_subject(chosen, spacing_mm=None), MARGIN_VOXELS)
    healthy = stretched(head, spec, np.random.default_rng(seed))
    labels = load_labels(chosen.image, chosen.mask, MARGIN_VOXELS).data
    lesions = draw_lesions(healthy, labels, BRIGHT, np.random.default_rng([seed, 1]))
    stacks = {
        which: simulate_stacks(
            head.data,
            head.mask,
            head.affine,
            orthogonal_settings(3, MOTION),
            np.random.default_rng([seed, 2]),
            fine=True,
        )
        for which, head in (("healthy", healthy), ("lesions", with_lesions(healthy, lesions)))
    }
    return LesionSubject(spec.name, healthy, tuple(lesions), stacks)


def lesion_run(
    subject: LesionSubject, n_stacks: int, reconstructors: Mapping[str, GaussianReconstructor], prior_alone: str
) -> LesionRun:
    """Reconstruct a head with and without lesions by each variant, and compare the difference with the lesions.

    Poses and gains of the slices are the true ones. A wrong pose blurs a lesion with and without the prior alike,
    whereas this study measures the effect of the prior alone. Both reconstructions must also be in one frame.

    Args:
        subject: the head.
        n_stacks: number of its first stacks to use.
        reconstructors: variant -> reconstructor; the prior volume of the last one is an additional variant.
        prior_alone: name of that additional variant.
    """
    start = time.perf_counter()
    found: dict[str, dict[str, ReconstructionResult]] = {}
    for variant, reconstructor in reconstructors.items():
        found[variant] = {
            which: reconstructor.reconstruct([one.stack for one in used], true_motion(used))
            for which, used in ((which, stacks[:n_stacks]) for which, stacks in subject.stacks.items())
        }
    seconds = time.perf_counter() - start
    pairs = {v: {w: _on_truth(r.volume, r.grid, subject) for w, r in of.items()} for v, of in found.items()}
    last = found[list(reconstructors)[-1]]
    pairs[prior_alone] = {w: _on_truth(r.prior, r.prior_grid, subject) for w, r in last.items()}
    volumes, shares = {}, {}
    for variant, pair in pairs.items():
        inside = subject.healthy.mask & (pair["healthy"] != 0)
        # slices have random gains: one factor brings both volumes of the pair to the truth's intensities
        scale = np.float32(subject.healthy.data[inside].mean() / pair["healthy"][inside].mean())
        volumes[variant] = pair["lesions"] * scale
        change = (pair["lesions"] - pair["healthy"]) * scale
        shares[variant] = [kept(change, lesion) for lesion in subject.lesions]
    return LesionRun(subject=subject, n_stacks=n_stacks, volumes=volumes, kept=shares, seconds=seconds)


def true_motion(stacks: list[SimulatedStack]) -> Registration:
    """The error-free registration of simulated stacks."""
    slices = slices_from_stacks([one.stack for one in stacks])
    rotation = np.concatenate([one.true_pose.rotation for one in stacks])
    shift = np.concatenate([one.true_pose.translation_mm for one in stacks])
    first = np.concatenate([[0], np.cumsum([len(one.gain) for one in stacks])])
    row = first[slices.stack_id] + slices.slice_index
    gain = np.concatenate([one.gain for one in stacks])[row]
    dropout = np.concatenate([one.dropout for one in stacks])[row]
    pose = RigidPose(rotation[row], shift[row])
    n = len(stacks)
    return Registration(
        slices=slices.with_motion(pose),
        gain=gain / np.exp(np.log(gain).mean()),
        weight=np.where(dropout, DROPOUT_WEIGHT, 1.0),
        ncc=np.ones(len(slices)),
        held_out=[1.0] * n if n > 1 else None,
        initialisation="true poses",
        initialisations={},
        interleave=[None] * n,
        n_segments=[1] * n,
        median_move_mm=[0.0] * n,
        orientation=None,
    )


def _on_truth(data: NDArray[np.float32], grid: VolumeGrid, subject: LesionSubject) -> NDArray[np.float32]:
    """A volume on the truth's grid; with true poses both are in one frame."""
    return resample(Volume(data, grid.affine, subject.name), subject.grid)
