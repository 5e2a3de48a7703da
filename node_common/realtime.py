"""Real-time set-up of a 1 kHz thread under CPython: scheduling, memory lock, garbage collection."""

import contextlib
import ctypes
import gc
import os
import resource
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from cutting_trainer.node_common.lifecycle import Stop
from cutting_trainer.node_common.timing import (
    RECEIVES,
    PeriodicLoop,
    request_preference,
    request_real_time,
)

PRIORITY = 40
RECEIVER_PRIORITY = 39
"""Of the threads that receive messages: below that of the loop, and above that of other programs,
behind which poses came 50 ms late."""
HELPER_PRIORITY = 20
"""Of all other threads of the process. One may compute for milliseconds, at the arrival of a mesh:
a driver of real-time priority goes before it."""
NICENESS = -15
"""Of all threads where no real-time priority is allowed, before that of the simulation."""
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4
CAP_IPC_LOCK = 14
MAX_LOCKED_SHARE = 0.5
"""Largest share of the machine's memory that a process may lock."""
SWITCH_INTERVAL_S = 0.00005
"""Time that another thread may keep the interpreter's lock when the loop wants it. It adds to every
wake-up that meets such a thread. With 0.2 ms, p99 and p99.9 of the bridge were 0.31 and 0.38 ms,
with this 0.15 and 0.26 ms, of two bridges side by side on a machine with a load of 25; cyclictest's
p99.9 was 0.3 ms."""


def run_real_time(loop: PeriodicLoop, tick: Callable[[int], None], stop: Stop) -> None:
    """Run a loop in the calling thread until `stop` is set.

    Call `prepare` in the same thread first, after everything long-lived exists.

    Args:
        loop: the deadlines.
        tick: the work of one period; gets the wake-up delay of the loop [ns].
        stop: ends the loop after the tick under way.
    """
    loop.start()
    while not stop.is_set():
        tick(loop.wait())


def prepare() -> str:
    """Set up the process for a 1 kHz loop: disable the collector, raise the threads' priorities.

    The loop needs the interpreter's lock. A helper thread that holds the lock and is preempted by
    another process would delay the loop. All threads of the process therefore get a real-time
    priority below that of the loop. They get it only after start-up: starting at such a priority
    occupies a core, and the kernel then throttles every real-time thread. Where no real-time
    priority is allowed, all threads ask for a niceness instead.

    Returns:
        A sentence for the log about scheduling and locked memory.
    """
    gc.disable()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    granted = request_real_time(PRIORITY)
    if 'granted' in granted:
        own = threading.get_native_id()
        for thread in Path('/proc/self/task').iterdir():
            if int(thread.name) != own:
                with contextlib.suppress(OSError):  # it has just ended
                    receives = (thread / 'comm').read_text().startswith(RECEIVES)
                    priority = os.sched_param(RECEIVER_PRIORITY if receives else HELPER_PRIORITY)
                    os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, priority)
    else:
        granted = f'{granted}; {request_preference(NICENESS)}'
    return f'{granted}; {lock_memory()}'


def lock_memory() -> str:
    """Lock the memory of the process against swapping, where that is safe.

    Only used pages are locked (MCL_ONFAULT): libraries and stacks map a gigabyte, most of which is
    never touched. Memory stays unlocked for a user with a limit, because the next allocation beyond
    it would fail.

    Returns:
        A sentence for the log.
    """
    if not (_unlimited() or _privileged()):
        kilobytes = resource.getrlimit(resource.RLIMIT_MEMLOCK)[1] >> 10
        return (
            f'memory is not locked: this user may lock {kilobytes} kB; allow it with "memlock '
            'unlimited" in /etc/security/limits.d and log in again'
        )
    page = os.sysconf('SC_PAGE_SIZE')
    resident = int(Path('/proc/self/statm').read_text().split()[1]) * page
    if resident > MAX_LOCKED_SHARE * os.sysconf('SC_PHYS_PAGES') * page:
        return f'memory is not locked: {resident / 1e6:.0f} MB are too much of this machine'
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT):
        return f'memory is not locked: {os.strerror(ctypes.get_errno())}'
    return f'memory is locked: {resident / 1e6:.0f} MB now'


def _unlimited() -> bool:
    """Return whether the user may lock memory without limit, after raising the soft limit."""
    hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)[1]
    if hard != resource.RLIM_INFINITY:
        return False
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (hard, hard))
    return True


def _privileged() -> bool:
    status = Path('/proc/self/status').read_text()
    effective = next(line for line in status.splitlines() if line.startswith('CapEff'))
    return bool(int(effective.split()[1], 16) >> CAP_IPC_LOCK & 1)
