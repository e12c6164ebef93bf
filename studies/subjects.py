"""Simulated subjects of the benchmarks: an atlas volume, stretched, sliced as it moves; kept in a folder."""

from __future__ import annotations

import json
import logging
import os
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from data_synth.atlas import TruthVolume, cropped, find_subjects, load_subject
from data_synth.export import save_simulation
from data_synth.simulator import orthogonal_settings, simulate_stacks
from g3r.errors import InputError

logger = logging.getLogger(__name__)

REPOSITORY = Path(__file__).resolve().parents[1]

BRIGHT = 1000.0
"""The 99.5th percentile of the truth in the mask; stacks are int16."""

STRETCH = 0.05
"""Each axis of a subject is longer or shorter by at most this share."""

RECORD_NAME = "simulation.json"


@dataclass(frozen=True)
class SubjectSpec:
    """All that decides a simulated subject.

    Args:
        name: folder in the cache.
        volume: subject of the atlas tree, as in `find_subjects`.
        motion: mild, moderate or severe.
        seed: of the stretch and of the simulation.
        bias: strength of the shading.
        stretch: bound of the random stretch of each axis.
        turned: whether the head lies in a random orientation instead of the atlas's.
    """

    name: str
    volume: str
    motion: str
    seed: int
    bias: float = 0.05
    stretch: float = STRETCH
    turned: bool = False


def test_data_folder() -> Path:
    """The folder that holds `atlas/` and `cases/`: `G3R_TEST_DATA`, or `shared/data` beside the repository.

    Raises:
        InputError: there is none.
    """
    folder = Path(os.environ.get("G3R_TEST_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        raise InputError(f"{folder}: no test data; set G3R_TEST_DATA to the folder with atlas/ and cases/")
    return folder


def simulated_subject(spec: SubjectSpec, atlas: Path, cache: Path) -> Path:
    """The folder of a subject, simulated if the cache does not hold it.

    Raises:
        InputError: the atlas lacks the volume, or the cache holds another subject of that name.
    """
    folder = cache / spec.name
    record = asdict(spec)
    if folder.is_dir():
        path = folder / RECORD_NAME
        found = json.loads(path.read_text(encoding="utf-8")).get("recipe") if path.is_file() else None
        if found != record:
            raise InputError(f"{folder}: made by another recipe; remove it or choose another --cache")
        return folder
    chosen = find_subjects(atlas, include=[spec.volume])
    rng = np.random.default_rng(spec.seed)
    truth = _stretched(cropped(load_subject(chosen[0], spacing_mm=None), 4), spec, rng)
    settings = orthogonal_settings(3, spec.motion, bias=spec.bias)
    stacks = simulate_stacks(truth.data, truth.mask, truth.affine, settings, rng, fine=True)
    extra = {"thickness_mm": settings[0].thickness_mm, "interleave": settings[0].interleave}
    save_simulation(folder, truth, stacks, {"recipe": record, **extra})
    logger.info("%s: simulated", spec.name)
    return folder


def _stretched(truth: TruthVolume, spec: SubjectSpec, rng: np.random.Generator) -> TruthVolume:
    """The volume with other voxel sizes (no resampling, no loss), centred, turned at random if asked."""
    factor = 1 + rng.uniform(-spec.stretch, spec.stretch, 3)
    turn = np.eye(3)
    if spec.turned:
        from scipy.spatial.transform import Rotation

        turn = Rotation.random(rng=rng).as_matrix()
    affine = np.eye(4)
    affine[:3, :3] = turn @ truth.affine[:3, :3] * factor
    affine[:3, 3] = -affine[:3, :3] @ ((np.array(truth.data.shape) - 1) / 2)
    return TruthVolume(name=spec.name, data=truth.data * np.float32(BRIGHT), mask=truth.mask, affine=affine)
