"""Stages of a run context: timing, storage, dropping and stopping."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from g3r.run.context import RunContext, StoppedAt
from g3r.run.stage_store import StageStore
from g3r.run.stop_request import StopRequest


@dataclass(frozen=True)
class Record:
    values: np.ndarray
    note: str


def never() -> Record:
    raise AssertionError("the stage was made again")


def context(folder: Path | None = None, *, resume: bool = False) -> RunContext:
    store = StageStore(folder, {"of": "this"}, [Record], resume=resume)
    return RunContext(store=store, stop_request=StopRequest())


def request_stop(run: RunContext) -> None:
    assert run.stop_request is not None
    run.stop_request.signal = 2


def test_a_finished_stage_is_read_and_not_made_again(tmp_path: Path) -> None:
    made = context(tmp_path / "stages").stage("one", lambda: Record(np.arange(3.0), "made"))
    again = context(tmp_path / "stages", resume=True)
    found = again.stage("one", never)
    assert found.note == made.note == "made"
    np.testing.assert_array_equal(found.values, made.values)
    assert again.store.resumed == ["one"]
    assert set(again.clock.seconds) == {"one"}


def test_a_stop_request_drops_a_droppable_stage_and_skips_the_next(tmp_path: Path) -> None:
    run = context(tmp_path / "stages")

    def make() -> Record:
        run.report("first")(3, 10)
        request_stop(run)
        raise KeyboardInterrupt

    assert run.droppable_stage("first", make) is None
    assert run.stopped_at == StoppedAt("first", 3, 10)
    assert run.stoppable_stage("second", never, lambda record: (0, 0)) is None
    assert run.stopped_at == StoppedAt("first", 3, 10)
    assert not list((tmp_path / "stages").glob("*.npz"))


def test_an_interrupt_that_nobody_asked_for_passes_through() -> None:
    def make() -> Record:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        context().droppable_stage("first", make)
    with pytest.raises(KeyboardInterrupt):
        RunContext().droppable_stage("first", make)


def test_a_stopped_loop_gives_what_it_has_and_is_not_kept(tmp_path: Path) -> None:
    run = context(tmp_path / "stages")

    def make() -> Record:
        request_stop(run)
        deadline = run.deadline(None)
        assert deadline is not None
        assert deadline.is_stopped()
        return Record(np.ones(4), "part")

    found = run.stoppable_stage("fit", make, lambda record: (len(record.values), 9))
    assert found is not None
    assert found.note == "part"
    assert run.stopped_at == StoppedAt("fit", 4, 9)
    assert not list((tmp_path / "stages").glob("*.npz"))


def test_without_a_stop_everything_is_kept(tmp_path: Path) -> None:
    run = context(tmp_path / "stages")
    run.droppable_stage("first", lambda: Record(np.ones(1), "a"))
    run.stoppable_stage("the second", lambda: Record(np.ones(2), "b"), lambda record: (2, 2))
    assert run.stopped_at is None
    assert {path.name for path in (tmp_path / "stages").glob("*.npz")} == {"first.npz", "the-second.npz"}
    assert RunContext().deadline(None) is None
