"""A loop goes before the threads that receive for it, and these before all others."""

import ctypes
import os
import threading
from collections.abc import Iterator

import pytest

from cutting_trainer.node_common import realtime

SET_NAME = 15


@pytest.fixture
def threads() -> Iterator[dict[str, int]]:
    """Two threads: one with the name of one in which DDS receives, and one that helps."""
    ended, numbers = threading.Event(), {}
    named = threading.Barrier(3)

    def live(name: str) -> None:
        ctypes.CDLL(None).prctl(SET_NAME, name.encode(), 0, 0, 0)
        numbers[name] = threading.get_native_id()
        named.wait()
        ended.wait()

    both = [threading.Thread(target=live, args=(name,)) for name in ('dds.udp.7411', 'helper')]
    for thread in both:
        thread.start()
    named.wait()
    yield numbers
    ended.set()
    for thread in both:
        thread.join()


def test_what_receives_is_next_to_the_loop_and_what_helps_is_behind(
    threads: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    given: dict[int, int] = {}
    monkeypatch.setattr(
        os, 'sched_setscheduler', lambda pid, _, how: given.update({pid: how.sched_priority})
    )
    monkeypatch.setattr(realtime, 'lock_memory', lambda: '')
    monkeypatch.setattr(realtime.gc, 'disable', lambda: None)
    monkeypatch.setattr(realtime.sys, 'setswitchinterval', lambda _: None)
    realtime.prepare()
    found = given[0], given[threads['dds.udp.7411']], given[threads['helper']]
    assert found == (realtime.PRIORITY, realtime.RECEIVER_PRIORITY, realtime.HELPER_PRIORITY)
    assert found[0] > found[1] > found[2]
