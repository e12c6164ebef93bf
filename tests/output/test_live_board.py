"""TensorBoard during a fit: entries are written while it runs, also when the run fails, and do not change it."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g3r.cli.infer import main
from g3r.fitting.observer import FitMoment
from g3r.geometry import VolumeGrid
from tests.faults.small_case import SmallCase, make_small_case
from tests.quick import QUICK_FIT

pytest.importorskip("tensorboard")

N_STEPS = QUICK_FIT.slice_stage.n_steps
N_PRIOR_STEPS = QUICK_FIT.prior_stage.n_steps


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> SmallCase:
    return make_small_case(tmp_path_factory.mktemp("case"))


def written(folder: Path) -> tuple[dict[str, list[tuple[int, float, float]]], dict[str, list[int]]]:
    """Scalars (step, value, time) and steps of images in the event files of a folder."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 0})
    events.Reload()
    tags: Mapping[str, Any] = events.Tags()
    scalars = {tag: [(one.step, one.value, one.wall_time) for one in events.Scalars(tag)] for tag in tags["scalars"]}
    return scalars, {tag: [one.step for one in events.Images(tag)] for tag in tags["images"]}


def test_every_step_of_both_fits_is_written_when_it_is_done(
    case: SmallCase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each entry goes to the writer before the fit makes the next step, which changes the parameters."""
    from torch.utils.tensorboard.writer import FileWriter

    from g3r.output.live_board import LiveBoard

    handed: list[tuple[str, int]] = []
    during: list[tuple[int, list[tuple[str, int]], float]] = []
    work, add = LiveBoard.__call__, FileWriter.add_summary

    def watched(self: LiveBoard, moment: FitMoment) -> None:
        n_before = len(handed)
        work(self, moment)
        if moment.slices is not None:
            during.append((moment.step, handed[n_before:], float(moment.cloud().amplitude.double().sum())))

    def counted(self: FileWriter, summary: Any, *arguments: Any, **options: Any) -> None:
        step: Any = options.get("global_step", arguments[0] if arguments else None)
        handed.extend((value.tag, step) for value in summary.value)
        add(self, summary, *arguments, **options)

    monkeypatch.setattr(LiveBoard, "__call__", watched)
    monkeypatch.setattr(FileWriter, "add_summary", counted)
    assert main(case.arguments(tmp_path / "out", "--tensorboard", str(tmp_path / "board"))) == 0
    assert (tmp_path / "out" / "volume.nii.gz").read_bytes() == case.volume  # logging does not change the result
    scalars, images = written(tmp_path / "board")
    assert [step for step, _, _ in scalars["fit to prior/loss/image"]] == list(range(1, N_PRIOR_STEPS + 1))
    steps, losses, _ = zip(*scalars["fit to slices/loss/image"], strict=True)
    assert steps == tuple(range(1, N_STEPS + 1))
    assert losses[-1] < losses[0]
    assert tuple(step for step, _, _ in during) == steps
    for step, those, _ in during:
        assert [number for tag, number in those if tag == "fit to slices/loss/image"] == [step]
    assert len({amplitude for _, _, amplitude in during}) == N_STEPS
    for name in ("moved mm/most", "turned degrees/most", "gain/lowest", "Gaussians", "seconds"):
        assert scalars[f"fit to slices/{name}"]
    assert scalars["seconds/registration"]
    assert images["fit to slices/axial"][0] <= 10
    assert images["volume/axial"] == [0]


def test_what_came_before_a_failure_is_there(case: SmallCase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The files are read during a step of the fit, as TensorBoard does."""
    from g3r.output.live_board import FLUSH_S, LiveBoard

    seen: list[int] = []
    work = LiveBoard.__call__

    def look(self: LiveBoard, moment: FitMoment) -> None:
        work(self, moment)
        if moment.slices is not None and moment.step in (5, 10):
            time.sleep(1.1 * FLUSH_S)
        if moment.step == 12 and moment.slices is not None:
            seen.extend(step for step, _, _ in written(tmp_path / "board")[0]["fit to slices/loss/image"])

    monkeypatch.setattr(LiveBoard, "__call__", look)
    assert main(case.arguments(tmp_path / "out", "--tensorboard", str(tmp_path / "board"))) == 0
    assert seen[:10] == list(range(1, 11))


def test_a_full_disk_ends_the_watching_and_not_the_run(
    case: SmallCase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from torch.utils.tensorboard import SummaryWriter

    def full(self: SummaryWriter) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(SummaryWriter, "flush", full)
    assert main(case.arguments(tmp_path / "out", "--tensorboard", str(tmp_path / "board"))) == 0
    assert (tmp_path / "out" / "volume.nii.gz").read_bytes() == case.volume
    assert caplog.text.count("the run goes on without it") == 1


@pytest.mark.parametrize("flip", [1, -1])
def test_sections_lie_in_the_middle_of_the_brain(flip: int) -> None:
    from g3r.output.live_board import middle_planes

    affine = np.diag([2.0 * flip, 2.0, 2.0, 1.0])
    affine[:3, 3] = 5, -7, 3
    mask = np.zeros((20, 22, 24), bool)
    mask[4:15, 6:13, 8:13] = True
    planes = middle_planes(VolumeGrid(mask.shape, affine), mask)
    center = affine[:3, :3] @ [9, 9, 10] + affine[:3, 3]
    np.testing.assert_allclose(planes.center_mm, np.tile(center, (3, 1)))
    np.testing.assert_allclose(np.linalg.det(planes.rotation), 1)
    np.testing.assert_allclose(np.abs(planes.rotation[:, :, 2]), np.eye(3), atol=1e-12)
    assert planes.shape.tolist() == [[13, 9], [21, 9], [21, 13]]
