"""--resume: the same bytes from any set of kept stages, and only from stages of the same run."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from g3r.errors import InputError
from g3r.gaussians import GaussianCloud
from g3r.geometry import RigidPose
from g3r.output.stored_records import STORED_RECORDS
from g3r.planning.stages import Stage, stage_rng
from g3r.run.context import RunContext
from g3r.run.output_folder import OutputFolder
from g3r.run.stage_file import UnreadableStage, as_stored, read_stage, write_stage
from g3r.run.stage_store import StageStore
from tests.faults.small_case import SmallCase, names
from tests.tally import Tally

NAMES = ("registration", "coarse volume", "prior", "fit to prior", "fit to slices")
STAGES = tuple(name.replace(" ", "-") for name in NAMES)


@pytest.fixture(scope="module")
def kept(case: SmallCase, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stages of a complete run that ends without writing its result."""
    folder = tmp_path_factory.mktemp("kept")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("g3r.output.result.ReconstructionResult.save", lambda *a, **b: (_ for _ in ()).throw(MemoryError))
        assert case.run(folder / "out") == 4
    assert names(folder / "out.unfinished" / "stages") == {"provenance.json", *(f"{s}.npz" for s in STAGES)}
    return folder / "out.unfinished"


@pytest.mark.parametrize("n_stages", range(6))
def test_the_same_bytes_from_any_number_of_finished_stages(
    case: SmallCase, kept: Path, tmp_path: Path, tally: Tally, n_stages: int
) -> None:
    with tally.case():
        shutil.copytree(kept, tmp_path / "out.unfinished")
        for stage in STAGES[n_stages:]:
            (tmp_path / "out.unfinished" / "stages" / f"{stage}.npz").unlink()
        assert case.run(tmp_path / "out", "--resume") == 0
        assert (tmp_path / "out" / "volume.nii.gz").read_bytes() == case.volume
        record = json.loads((tmp_path / "out" / "run.json").read_text())
        assert record["resumed"] == list(NAMES[:n_stages])
        assert set(record["seconds"]) >= set(NAMES)
        assert names(tmp_path) == {"out"}


@pytest.mark.parametrize("n_bytes", [0, 100, 20_000])
def test_a_stage_that_was_cut_off_is_made_again(
    case: SmallCase, kept: Path, tmp_path: Path, tally: Tally, n_bytes: int
) -> None:
    with tally.case():
        shutil.copytree(kept, tmp_path / "out.unfinished")
        path = tmp_path / "out.unfinished" / "stages" / "fit-to-prior.npz"
        path.write_bytes(path.read_bytes()[:n_bytes])
        assert case.run(tmp_path / "out", "--resume") == 0
        assert (tmp_path / "out" / "volume.nii.gz").read_bytes() == case.volume
        record = json.loads((tmp_path / "out" / "run.json").read_text())
        assert "fit to prior" not in record["resumed"]


@pytest.mark.parametrize(("key", "n_stages"), [("seed", 5), ("distillation", 5)])
def test_stages_of_another_run_are_refused_by_name(
    case: SmallCase,
    kept: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    tally: Tally,
    key: str,
    n_stages: int,
) -> None:
    with tally.case() as one:
        shutil.copytree(kept, tmp_path / "out.unfinished")
        record = json.loads(case.config.read_text())
        record["settings"][key] = 7 if key == "seed" else False
        (tmp_path / "other.json").write_text(json.dumps(record))
        arguments = SmallCase(case.folder, tmp_path / "other.json", b"")
        assert arguments.run(tmp_path / "out", "--resume") == 3
        assert f"setting {key}; " in capsys.readouterr().err
        assert len(list((tmp_path / "out.unfinished" / "stages").glob("*.npz"))) == n_stages  # no stage is lost
        one.refused()


def test_without_resume_a_run_begins_anew(case: SmallCase, kept: Path, tmp_path: Path, tally: Tally) -> None:
    with tally.case():
        shutil.copytree(kept, tmp_path / "out.unfinished")
        assert case.run(tmp_path / "out") == 0
        assert json.loads((tmp_path / "out" / "run.json").read_text())["resumed"] == []
        assert (tmp_path / "out" / "volume.nii.gz").read_bytes() == case.volume
        assert names(tmp_path) == {"out"}


def test_nothing_of_a_living_run_is_touched(
    case: SmallCase, tmp_path: Path, capsys: pytest.CaptureFixture[str], tally: Tally
) -> None:
    with tally.case() as one, OutputFolder(tmp_path / "out") as living:
        (living.staging / "stages").mkdir()
        (living.staging / "stages" / "registration.npz").write_text("mine")
        assert case.run(tmp_path / "out") == 3
        assert f"another run is writing it (process {os.getpid()})" in capsys.readouterr().err
        assert names(living.staging) == {"lock", "process", "stages"}
        assert (living.staging / "stages" / "registration.npz").read_text() == "mine"
        one.refused()


def test_the_lock_goes_with_a_process_however_it_ends(tmp_path: Path, tally: Tally) -> None:
    code = (
        "import sys, time\nfrom g3r.run.output_folder import OutputFolder\n"
        "run = OutputFolder(sys.argv[1]).__enter__()\nprint('in', flush=True)\ntime.sleep(60)"
    )
    with tally.case():
        line = [sys.executable, "-c", code, str(tmp_path / "out")]
        with subprocess.Popen(line, stdout=subprocess.PIPE, cwd=Path(__file__).parents[2]) as other:
            assert other.stdout is not None
            assert other.stdout.readline() == b"in\n"
            with pytest.raises(InputError, match=f"process {other.pid}"), OutputFolder(tmp_path / "out"):
                pass
            other.kill()
            other.wait()
        with OutputFolder(tmp_path / "out"):
            pass
        assert names(tmp_path) == set()


def test_an_exchange_that_was_cut_short_is_undone_or_finished(tmp_path: Path, tally: Tally) -> None:
    out, unfinished = tmp_path / "out", tmp_path / "out.unfinished"
    with tally.case():  # killed between two renames: the earlier result is restored
        (unfinished / "backup").mkdir(parents=True)
        (unfinished / "new").mkdir()
        (unfinished / "backup" / "volume").write_text("old")
        with OutputFolder(out, ["volume"]):
            assert (out / "volume").read_text() == "old"
        assert names(tmp_path) == {"out"}
    with tally.case():  # killed after them: files that are not part of a result are moved over
        (unfinished / "backup").mkdir(parents=True)
        (unfinished / "backup" / "volume").write_text("older")
        (unfinished / "backup" / "notes").write_text("mine")
        with OutputFolder(out, ["volume"]):
            pass
        assert (out / "volume").read_text() == "old"
        assert names(out) == {"volume", "notes"}
        assert names(tmp_path) == {"out"}


def test_a_link_as_output_stays_a_link(case: SmallCase, tmp_path: Path, tally: Tally) -> None:
    with tally.case():
        (tmp_path / "there").mkdir()
        (tmp_path / "out").symlink_to(tmp_path / "there")
        assert case.run(tmp_path / "out") == 0
        assert (tmp_path / "out").is_symlink()
        assert (tmp_path / "there" / "volume.nii.gz").read_bytes() == case.volume
        assert names(tmp_path) == {"out", "there"}


def test_a_stage_comes_back_from_its_file_bit_by_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pose = RigidPose.from_rotvec(rng.normal(size=(3, 3)), rng.normal(size=(3, 3)))
    cloud = GaussianCloud.of([torch.randn(4, n) for n in (3, 3, 4)] + [torch.randn(4)], np.ones(3))
    strided = rng.normal(size=(6, 8))[::2, ::2]
    value = (pose, cloud, {"a": [1, 2.5, None, "x", True]}, (0.1, np.float64(1 / 3)), strided, strided[:0])
    write_stage(tmp_path / "one.npz", value)
    back = read_stage(tmp_path / "one.npz", STORED_RECORDS)
    same = as_stored(value)
    for one in (back, same):
        np.testing.assert_array_equal(one[0].rotation, pose.rotation)
        assert torch.equal(one[1].quaternion_wxyz, cloud.quaternion_wxyz)
        assert one[2:4] == value[2:4]
        np.testing.assert_array_equal(one[4], strided)
        assert one[4].flags.c_contiguous
        assert one[5].shape == (0, 4)
    with pytest.raises(TypeError, match="no place"):
        write_stage(tmp_path / "two.npz", object())
    with pytest.raises(UnreadableStage):
        read_stage(tmp_path / "one.npz", [RigidPose])  # a record that is not expected
    assert names(tmp_path) == {"one.npz"}


def test_stages_draw_their_own_numbers() -> None:
    stages = (Stage.FIT_TO_PRIOR, Stage.FIT_TO_PRIOR, Stage.FIT_TO_SLICES)
    first, again, other = (stage_rng(3, stage).random() for stage in stages)
    assert first == again != other
    assert stage_rng(4, Stage.FIT_TO_PRIOR).random() != first


def test_seconds_of_a_stage_are_those_that_it_took(tmp_path: Path) -> None:
    def work() -> float:
        time.sleep(0.03)
        return 1.0

    for resume in (False, True):
        run = RunContext(store=StageStore(tmp_path / "stages", {"a": "b"}, resume=resume))
        assert run.stage(Stage.REGISTRATION, work) == 1.0
        assert run.clock.seconds["registration"] >= 0.03
        assert run.store.resumed == ["registration"] * resume
