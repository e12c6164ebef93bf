"""Signals during a run, and loops that they cut."""

from __future__ import annotations

import signal
import threading

import pytest

from g3r.run.deadline import Deadline, Pace, paced
from g3r.run.stop_request import Interruption


def test_a_first_signal_raises_until_there_is_something_to_keep():
    with Interruption() as one:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert one.asked()
        assert one.exit_code == 130
    with Interruption() as one:
        one.postpone()
        signal.raise_signal(signal.SIGTERM)
        assert one.asked()
        assert one.exit_code == 143
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_the_handlers_from_before_come_back():
    before = signal.getsignal(signal.SIGTERM)
    with Interruption():
        assert signal.getsignal(signal.SIGTERM) != before
    assert signal.getsignal(signal.SIGTERM) == before


def test_in_another_thread_signals_are_left_alone():
    before, found = signal.getsignal(signal.SIGINT), []

    def work() -> None:
        with Interruption():
            found.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [before]


def test_a_cut_ends_a_loop_at_the_next_step_whatever_the_least():
    one, done = Interruption(), []
    for step, fraction in paced(10, one.cut(None), least=8):
        done.append((step, fraction))
        if step == 3:
            one.signal = signal.SIGINT
    assert done == list(paced(10))[:4]
    assert list(paced(10, one.cut(None))) == []


def test_waiting_for_a_cut_changes_no_schedule():
    assert list(paced(45, Interruption().cut(None))) == list(paced(45))


def test_parts_of_a_deadline_can_be_cut_too():
    one = Interruption()
    deadline = one.cut(Deadline.after(100.0)).part(0.5)
    assert deadline.remaining_s <= 50
    one.signal = signal.SIGINT
    assert list(paced(3, deadline)) == []


class Clock:
    now = 0.0

    def __call__(self) -> float:
        self.now += 1.0
        return self.now


def test_what_the_clock_decided_is_repeated_without_it():
    pace = Pace()
    deadline = Deadline(30.0, Clock(), pace=pace)
    first = [list(paced(100, deadline.part(0.5))), list(paced(4, deadline)), deadline.has_passed()]
    assert len(first[0]) < 100
    again = Deadline(pace=Pace(pace.loops, repeating=True))
    assert [list(paced(100, again.part(0.5))), list(paced(4, again)), again.has_passed()] == first
    assert list(paced(5, again)) == []  # more loops than there were
