"""Subjects of the studies: simulated subjects, cached in a folder, and the cases of the test data."""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from data_synth.atlas import TruthVolume, cropped, find_subjects, load_subject
from data_synth.export import save_simulation
from data_synth.simulator import SIMULATOR_VERSION, StackSettings, orthogonal_settings, simulate_stacks
from g3r.errors import InputError
from g3r.evaluation.case import SimulatedCase, load_case

logger = logging.getLogger(__name__)

REPOSITORY = Path(__file__).resolve().parents[1]

BRIGHT = 1000.0
"""The 99.5th percentile of the truth in the mask; stacks are int16."""

STRETCH = 0.05
"""Each axis of a subject is stretched or shortened by at most this share."""

RECORD_NAME = "simulation.json"

THICKNESS_MM = {"sb28-mild-gap": 3.0}
"""Slice thickness of cases whose slices are thinner than their spacing and that have no simulation.json to state it."""

ORDER = ("*-none", "*-mild*", "*-moderate", "*-severe", "*-single")

USUAL_CASE = "sta30-moderate"


@dataclass(frozen=True, kw_only=True)
class SubjectSpec:
    """Specification of a simulated subject.

    Args:
        name: folder in the cache; by default motion, seed and the last part of the volume.
        volume: name of an atlas subject, as in `find_subjects`.
        motion: mild, moderate or severe.
        seed: of the stretch and of the simulation.
        bias: strength of the bias field.
        stretch: bound of the random stretch of each axis.
        turned: whether the head has a random orientation instead of that of the atlas.
    """

    name: str = ""
    volume: str
    motion: str
    seed: int
    bias: float = 0.05
    stretch: float = STRETCH
    turned: bool = False

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", f"{self.motion}-{self.seed}-{self.volume.rsplit('/', 1)[-1]}")

    def acquisition(self, n_stacks: int) -> list[StackSettings]:
        """Acquisition settings of its stacks."""
        return orthogonal_settings(n_stacks, self.motion, bias=self.bias)

    def truth(self, atlas: Path | None) -> TruthVolume:
        """Its volume as in the atlas.

        Args:
            atlas: folder of the atlas; None for a subject that does not come from an atlas.

        Raises:
            InputError: the atlas lacks the volume.
        """
        assert atlas is not None
        return load_subject(find_subjects(atlas, include=[self.volume])[0], spacing_mm=None)


@dataclass(frozen=True, kw_only=True)
class SizedSubject(SubjectSpec):
    """A subject with its own pixel size, slice thickness and gap.

    Args:
        pixel_mm: in-plane spacing.
        thickness_mm: of a slice.
        gap_mm: between the facing edges of neighbouring slices.
    """

    pixel_mm: float
    thickness_mm: float
    gap_mm: float = 0.0

    def acquisition(self, n_stacks: int) -> list[StackSettings]:
        """Acquisition settings of its stacks."""
        usual = super().acquisition(n_stacks)
        return [
            replace(one, resolution_mm=self.pixel_mm, thickness_mm=self.thickness_mm, gap_mm=self.gap_mm)
            for one in usual
        ]


def data_folder(part: str) -> Path:
    """Folder `atlas` or `cases` of the test data: below `G3R_TEST_DATA`, or `shared/data` next to the repository.

    Raises:
        InputError: the folder does not exist.
    """
    folder = Path(os.environ.get("G3R_TEST_DATA", REPOSITORY.parent / "shared" / "data")) / part
    if not folder.is_dir():
        raise InputError(f"{folder}: no test data; set G3R_TEST_DATA to the folder with atlas/ and cases/")
    return folder


def is_named(name: str, patterns: Sequence[str]) -> bool:
    """Whether a part of a name matches one of the patterns of --cases."""
    return any(fnmatch(name, f"*{pattern}*") for pattern in patterns)


def case_folders(patterns: Sequence[str], root: Path | None = None) -> list[Path]:
    """The cases of the test data whose name has a part that matches a pattern, by increasing motion.

    Raises:
        InputError: none matches.
    """
    root = root or data_folder("cases")
    found = [f for f in sorted(root.glob("*")) if f.is_dir() and is_named(f.name, patterns)]
    if not found:
        raise InputError(f"{root}: no case named {' or '.join(patterns)}; change --cases or G3R_TEST_DATA")
    return sorted(found, key=lambda f: next((n for n, p in enumerate(ORDER) if fnmatch(f.name, p)), len(ORDER)))


def chosen_folders(folders: Sequence[Path]) -> Sequence[Path]:
    """The given folders, or, without any, the representative case of the test data."""
    return folders or [data_folder("cases") / USUAL_CASE]


def read_case(folder: Path, n_stacks: int | None = None) -> SimulatedCase:
    """A case with its first `n_stacks` stacks (None: all) and the slice thickness even if no file states it."""
    case = load_case(folder, THICKNESS_MM.get(folder.name))
    return replace(case, stacks=case.stacks[:n_stacks])


def simulated_case(spec: SubjectSpec, cache: Path, n_stacks: int | None = None) -> SimulatedCase:
    """Return a subject of the test data's atlas, simulated if the cache lacks it.

    Args:
        spec: of the subject.
        cache: folder of simulated subjects.
        n_stacks: number of its first stacks to read; None for all.
    """
    return read_case(simulated_subject(spec, data_folder("atlas"), cache), n_stacks)


def simulated_subject(spec: SubjectSpec, atlas: Path | None, cache: Path) -> Path:
    """The folder of a subject, simulated if the cache does not hold it.

    Args:
        spec: the subject.
        atlas: folder of the atlas; None for a subject that does not come from an atlas.
        cache: folder of simulated subjects.

    Raises:
        InputError: the atlas lacks the volume, or the cache holds another subject of that name.
    """
    folder = cache / spec.name
    # as JSON would return it: tuples become lists
    record = json.loads(json.dumps(asdict(spec) | {"simulator": SIMULATOR_VERSION}))
    if folder.is_dir():
        path = folder / RECORD_NAME
        found = json.loads(path.read_text(encoding="utf-8")).get("spec") if path.is_file() else None
        if found != record:
            raise InputError(
                f"{folder}: made by another specification or simulator; remove it or choose another --cache"
            )
        return folder
    rng = np.random.default_rng(spec.seed)
    truth = stretched(cropped(spec.truth(atlas), 4), spec, rng)
    settings = spec.acquisition(3)
    stacks = simulate_stacks(truth.data, truth.mask, truth.affine, settings, rng, fine=True)
    extra = {"thickness_mm": settings[0].thickness_mm, "interleave": settings[0].interleave}
    # several processes may simulate the same subject at the same time; the first to finish keeps its folder
    made = cache / f".{spec.name}-{os.getpid()}"
    save_simulation(made, truth, stacks, {"spec": record, **extra})
    try:
        made.rename(folder)
    except OSError:
        if not folder.is_dir():
            raise
        shutil.rmtree(made)
    logger.info("%s: simulated", spec.name)
    return folder


def stretched(truth: TruthVolume, spec: SubjectSpec, rng: np.random.Generator) -> TruthVolume:
    """The volume with other voxel sizes (no resampling, no loss), centred, in a random orientation if asked.

    Args:
        truth: the volume of the atlas.
        spec: the subject.
        rng: of the stretch, and of the orientation.
    """
    factor = 1 + rng.uniform(-spec.stretch, spec.stretch, 3)
    turn = np.eye(3)
    if spec.turned:
        from scipy.spatial.transform import Rotation

        turn = Rotation.random(rng=rng).as_matrix()
    affine = np.eye(4)
    affine[:3, :3] = turn @ truth.affine[:3, :3] * factor
    affine[:3, 3] = -affine[:3, :3] @ ((np.array(truth.data.shape) - 1) / 2)
    return TruthVolume(name=spec.name, data=truth.data * np.float32(BRIGHT), mask=truth.mask, affine=affine)
