"""What a thread needs to keep 1 kHz under CPython."""

import contextlib
import gc
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from tissue_sim.lifecycle import Stop
from tissue_sim.timing import PeriodicLoop, request_real_time

PRIORITY = 40
HELPER_PRIORITY = 20
SWITCH_INTERVAL = 0.00005
"""[s] that another thread may go on in the interpreter when the loop wants its lock: it is in every
wake-up that meets one. With 0.2 ms, p99 and p99.9 of the bridge were 0.31 and 0.38 ms, with this
0.15 and 0.26 ms, of two bridges side by side on a machine with a load of 25; cyclictest's p99.9
was 0.3 ms."""


def run_real_time(loop: PeriodicLoop, tick: Callable[[int], None], stop: Stop) -> None:
    """Runs a loop in the calling thread until `stop` is set.

    Call `prepare` in the same thread first, after everything long-lived exists.

    Args:
        loop: the deadlines.
        tick: the work of one period; gets how late the loop woke [ns].
        stop: ends the loop after the tick under way.
    """
    loop.start()
    while not stop.is_set():
        tick(loop.wait())


def prepare() -> str:
    """Takes from the calling thread what makes it late: the collector, and other threads' turns.

    The loop needs the interpreter's lock. A helper thread that holds it and loses its core to
    another process would keep the loop waiting for as long as that process likes: so all threads
    of the process get a real-time priority, below that of the loop. Not earlier: starting up at
    such a priority takes a core whole, and the kernel then holds back every real-time thread.

    Returns:
        A sentence for the log about real-time scheduling.
    """
    gc.disable()
    sys.setswitchinterval(SWITCH_INTERVAL)
    granted = request_real_time(PRIORITY)
    if 'granted' in granted:
        own = threading.get_native_id()
        for thread in Path('/proc/self/task').iterdir():
            if int(thread.name) != own:
                with contextlib.suppress(OSError):  # it has just ended
                    helper = os.sched_param(HELPER_PRIORITY)
                    os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, helper)
    return granted
