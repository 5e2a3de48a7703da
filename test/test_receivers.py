"""Threads that receive go before a loop that waits for messages in vain, and after it else."""

import ctypes
import os
import threading
from collections.abc import Iterator

import pytest

from cutting_trainer.node_common import realtime
from cutting_trainer.node_common.realtime import MAX_VAIN_TICKS, URGENT_TICKS, Receivers

SET_NAME = 15


@pytest.fixture
def receiver() -> Iterator[int]:
    """A thread with the name of one in which DDS receives; its number."""
    named, ended = threading.Event(), threading.Event()

    def receive() -> None:
        ctypes.CDLL(None).prctl(SET_NAME, b'dds.udp.7411', 0, 0, 0)
        named.set()
        ended.wait()

    thread = threading.Thread(target=receive)
    thread.start()
    named.wait()
    assert thread.native_id is not None
    yield thread.native_id
    ended.set()
    thread.join()


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Threads and the priorities that they were given, as this user may not give them."""
    record: list[tuple[int, int]] = []
    monkeypatch.setattr(
        os, 'sched_setscheduler', lambda pid, _, how: record.append((pid, how.sched_priority))
    )
    return record


def run(receivers: Receivers, ticks: int, *, arrived: bool) -> None:
    for _ in range(ticks):
        receivers.note(arrived=arrived)


def test_they_go_before_the_loop_from_the_last_tick_that_it_may_wait_in_vain(
    receiver: int, given: list[tuple[int, int]]
) -> None:
    receivers = Receivers()
    for _ in range(100):  # a pose may come just after a tick
        run(receivers, MAX_VAIN_TICKS - 1, arrived=False)
        run(receivers, 1, arrived=True)
    assert not given
    run(receivers, 10 * MAX_VAIN_TICKS, arrived=False)
    assert given == [(receiver, realtime.URGENT_PRIORITY)]
    assert realtime.URGENT_PRIORITY > realtime.PRIORITY > realtime.HELPER_PRIORITY


def test_they_go_after_it_again_once_it_has_had_messages_for_a_while(
    receiver: int, given: list[tuple[int, int]]
) -> None:
    receivers = Receivers()
    run(receivers, MAX_VAIN_TICKS, arrived=False)
    run(receivers, URGENT_TICKS - MAX_VAIN_TICKS, arrived=True)
    run(receivers, MAX_VAIN_TICKS, arrived=False)
    run(receivers, URGENT_TICKS - 1, arrived=True)
    assert len(given) == 1
    run(receivers, 1, arrived=True)
    assert given[1:] == [(receiver, realtime.HELPER_PRIORITY)]
    run(receivers, MAX_VAIN_TICKS, arrived=False)
    assert given[2:] == [(receiver, realtime.URGENT_PRIORITY)]


def test_a_user_who_may_not_set_priorities_has_the_loop_go_on(
    receiver: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, 'sched_setscheduler', refuse)
    run(Receivers(), 10 * MAX_VAIN_TICKS, arrived=False)
