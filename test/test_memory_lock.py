"""Memory of the 1 kHz processes is locked where that is allowed, and left alone where it is not.

So is the niceness of a user who may have no real-time priority.
"""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.long

LOCK = """
import mmap, resource, sys
from cutting_trainer.node_common import realtime
if sys.argv[1] == 'limited':
    realtime._privileged = lambda: False
    realtime._unlimited = lambda: False
if sys.argv[1] == 'huge':
    realtime.MAX_LOCKED_SHARE = 0.0
said = realtime.lock_memory()
unused = mmap.mmap(-1, 1 << 30)  # as libraries do: mapped, not touched
values = dict(line.split(':') for line in open('/proc/self/status'))
print(said)
print(int(values['VmLck'].split()[0]), int(values['VmRSS'].split()[0]))
"""


def said_and_locked(how: str) -> tuple[str, int, int]:
    """What was said; locked and resident memory [kB]."""
    done = subprocess.run(
        [sys.executable, '-c', LOCK, how], capture_output=True, text=True, check=True
    )
    said, sizes = done.stdout.splitlines()
    locked, resident = map(int, sizes.split())
    return said, locked, resident


def test_memory_is_locked_where_the_system_allows_it_and_a_mapping_is_not_filled() -> None:
    said, locked, resident = said_and_locked('as it is')
    assert said.startswith('memory is')
    assert ('is locked' in said) == (locked > 0)
    assert resident < 600_000


@pytest.mark.parametrize(('how', 'why'), [('limited', 'may lock'), ('huge', 'too much')])
def test_memory_is_left_alone_where_locking_would_do_harm(how: str, why: str) -> None:
    said, locked, _ = said_and_locked(how)
    assert said.startswith('memory is not locked') and why in said
    assert locked == 0


PREFER = """
import os, sys, threading
from pathlib import Path
from cutting_trainer.node_common import realtime, timing
def refuse(*_):
    raise PermissionError
os.sched_setscheduler = refuse
asked = {}
def note(_, thread, niceness):
    if sys.argv[1] == 'refused':
        raise PermissionError
    asked[thread] = niceness
os.setpriority = note
threading.Thread(target=threading.Event().wait, daemon=True).start()
print(realtime.prepare())
print(len(asked) == len(list(Path('/proc/self/task').iterdir())), set(asked.values()))
"""


@pytest.mark.parametrize('how', ['allowed', 'refused'])
def test_without_a_real_time_priority_all_threads_ask_for_a_niceness(how: str) -> None:
    done = subprocess.run(
        [sys.executable, '-c', PREFER, how], capture_output=True, text=True, check=True
    )
    said, asked = done.stdout.splitlines()
    assert 'real-time scheduling is not allowed' in said and 'memory' in said
    if how == 'allowed':
        assert 'preferred to other processes: niceness -15' in said
        assert asked == 'True {-15}'
    else:
        assert 'nice -20' in said
