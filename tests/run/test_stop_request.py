"""Stop requests by signals, and the loops that they cut."""

from __future__ import annotations

import signal
import threading

import pytest

from g3r.run.deadline import Deadline, LoopRecord, timed_steps
from g3r.run.stop_request import StopRequest


def test_a_first_signal_raises_until_there_is_something_to_keep() -> None:
    with StopRequest() as one:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert one.is_requested()
        assert one.exit_code == 130
    with StopRequest() as one:
        one.postpone()
        signal.raise_signal(signal.SIGTERM)
        assert one.is_requested()
        assert one.exit_code == 143
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_the_handlers_from_before_come_back() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with StopRequest():
        assert signal.getsignal(signal.SIGTERM) != before
    assert signal.getsignal(signal.SIGTERM) == before


def test_in_another_thread_signals_are_left_alone() -> None:
    before, found = signal.getsignal(signal.SIGINT), []

    def work() -> None:
        with StopRequest():
            found.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [before]


def test_a_cut_ends_a_loop_at_the_next_step_whatever_the_least() -> None:
    one, done = StopRequest(), []
    for step, fraction in timed_steps(10, one.with_deadline(None), least=8):
        done.append((step, fraction))
        if step == 3:
            one.signal = signal.SIGINT
    assert done == list(timed_steps(10))[:4]
    assert list(timed_steps(10, one.with_deadline(None))) == []


def test_waiting_for_a_cut_changes_no_schedule() -> None:
    assert list(timed_steps(45, StopRequest().with_deadline(None))) == list(timed_steps(45))


def test_parts_of_a_deadline_can_be_cut_too() -> None:
    one = StopRequest()
    deadline = one.with_deadline(Deadline.after(100.0)).part(0.5)
    assert deadline.remaining_s <= 50
    one.signal = signal.SIGINT
    assert list(timed_steps(3, deadline)) == []


class Clock:
    now = 0.0

    def __call__(self) -> float:
        self.now += 1.0
        return self.now


def test_what_the_clock_decided_is_repeated_without_it() -> None:
    loop_record = LoopRecord()
    deadline = Deadline(30.0, Clock(), loop_record=loop_record)
    steps = list(timed_steps(100, deadline.part(0.5)))
    first = [steps, list(timed_steps(4, deadline)), deadline.record_whether_passed()]
    assert len(steps) < 100
    again = Deadline(loop_record=LoopRecord(loop_record.loops, repeating=True))
    repeated = [list(timed_steps(100, again.part(0.5))), list(timed_steps(4, again)), again.record_whether_passed()]
    assert repeated == first
    assert list(timed_steps(5, again)) == []  # more loops than were recorded
