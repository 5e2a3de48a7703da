"""Periodic loops with absolute deadlines, their statistics, and scheduling priorities."""

import contextlib
import os
import threading
import time
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

NANOSECONDS = 1_000_000_000
MAX_TIMELY_LATENESS_S = 0.0005
"""Latest wake-up after the deadline that still counts as timely."""
FRAME_NICENESS = -10
"""Niceness of the processes on the critical path of a tissue frame."""
RECEIVES = 'dds.udp'
"""How the names of the threads begin in which DDS receives."""
_GROUP = Path('/proc/self/autogroup')


class PeriodicLoop:
    """Sleeps until absolute deadlines and keeps the statistics of one loop.

    A loop that oversleeps a period skips the missed deadlines and counts them. It never runs twice
    at once to catch up.

    Args:
        rate: deadlines a second [Hz].
        window: periods covered by `report`.
        phase: of the deadlines, as a share of the period [-]. Loops of one machine that share a
            processor meet less often with different ones.
    """

    def __init__(self, rate: float, *, window: int = 4096, phase: float = 0.0) -> None:
        self.period_ns = round(NANOSECONDS / rate)
        self._offset = round(phase * self.period_ns)
        self.missed = 0
        self.ticks = 0
        self._starts, self._lateness, self._busy = (_integers(window) for _ in range(3))
        self._reported = self._reported_missed = 0
        self._deadline = 0
        self._woken = 0

    def start(self) -> None:
        """Set the first deadline, at most one period from now."""
        begun = (time.monotonic_ns() - self._offset) // self.period_ns
        self._deadline = (begun + 1) * self.period_ns + self._offset

    def wait(self) -> int:
        """Sleep until the next deadline.

        Returns:
            Wake-up delay [ns].
        """
        now = time.monotonic_ns()
        if self.ticks:
            self._busy[(self.ticks - 1) % len(self._busy)] = now - self._woken
        if now < self._deadline:
            time.sleep((self._deadline - now) / NANOSECONDS)
            now = time.monotonic_ns()
        late = now - self._deadline
        skipped = max(late, 0) // self.period_ns
        self.missed += skipped
        self._deadline += (skipped + 1) * self.period_ns
        slot = self.ticks % len(self._starts)
        self._starts[slot] = now
        self._lateness[slot] = late
        self._woken = now
        self.ticks += 1
        return late

    def report(self) -> dict[str, float]:
        """Return statistics of the ticks since the last report, at most `window` of them.

        Returns:
            rate [Hz], period_p50, period_p99, period_max [s], lateness_p50, lateness_p99,
            lateness_p999, lateness_max [s], busy_p50, busy_p99, busy_max [s] (work between two
            sleeps), within (share of periods within half a period of the nominal one), timely
            (share of deadlines that were met within `MAX_TIMELY_LATENESS_S`; a missed
            one was not), ticks and missed (totals).
        """
        count = min(self.ticks - self._reported, len(self._starts))
        missed = self.missed - self._reported_missed
        self._reported, self._reported_missed = self.ticks, self.missed
        totals = {'ticks': float(self.ticks), 'missed': float(self.missed)}
        if count < 3:
            return totals
        slots = np.arange(self.ticks - count, self.ticks) % len(self._starts)
        starts, late, busy_ns = map(np.array, (self._starts, self._lateness, self._busy))
        periods = np.diff(starts[slots]) / NANOSECONDS
        lateness = late[slots] / NANOSECONDS
        busy = busy_ns[slots[:-1]] / NANOSECONDS
        nominal = self.period_ns / NANOSECONDS
        return totals | {
            'rate': float(1 / periods.mean()),
            'timely': float(np.sum(lateness <= MAX_TIMELY_LATENESS_S) / (count + missed)),
            'within': float(np.mean(np.abs(periods - nominal) <= nominal / 2)),
            **_quantiles('period', periods, (50, 99)),
            **_quantiles('lateness', lateness, (50, 99, 99.9)),
            **_quantiles('busy', busy, (50, 99)),
        }


class FairLock:
    """A lock that a thread cannot take again before a waiting thread has had it.

    A loop behind its deadlines holds its lock nearly always. It would take a `threading.Lock` again
    before a waiting thread wakes, for seconds.
    """

    def __init__(self) -> None:
        self._next, self._lock = threading.Lock(), threading.Lock()

    def __enter__(self) -> None:
        with self._next:  # the next owner holds this: other threads queue behind it
            self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


class Durations:
    """Keeps the newest durations of one kind.

    Args:
        name: prefix of the values in `report`.
        window: durations kept.
    """

    def __init__(self, name: str, *, window: int = 4096) -> None:
        self._name = name
        self._values = _integers(window)
        self._count = self._reported = 0

    def add(self, duration_ns: int) -> None:
        """Add a duration [ns]."""
        self._values[self._count % len(self._values)] = duration_ns
        self._count += 1

    def report(self) -> dict[str, float]:
        """Return p50, p99, p999 and max [s] since the last report, of at most `window`
        durations.
        """
        count = min(self._count - self._reported, len(self._values))
        self._reported = self._count
        if not count:
            return {}
        slots = np.arange(self._count - count, self._count) % len(self._values)
        values = np.array(self._values)[slots] / NANOSECONDS
        return _quantiles(self._name, values, (50, 99, 99.9))


def _integers(count: int) -> 'array[int]':
    """Return zeros of 64 bits. One is set in a third of the time of a NumPy array's."""
    return array('q', bytes(8 * count))


def _quantiles(name: str, values: np.ndarray, percents: tuple[float, ...]) -> dict[str, float]:
    named = {
        f'{name}_p{str(p).replace(".", "")}': float(q)
        for p, q in zip(percents, np.percentile(values, percents), strict=True)
    }
    return named | {f'{name}_max': float(values.max())}


def request_real_time(priority: int) -> str:
    """Ask for SCHED_FIFO for the calling thread.

    Returns:
        A sentence for the log: the granted policy, or the cause and remedy.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        return (
            'real-time scheduling is not allowed for this user: expect wake-up delays of '
            'milliseconds under load; allow it with "rtprio 80" in /etc/security/limits.d and log '
            'in again'
        )
    except (AttributeError, OSError) as error:
        return f'real-time scheduling is not available here: {error}'
    return f'real-time scheduling granted: SCHED_FIFO, priority {priority}'


def request_preference(niceness: int) -> str:
    """Ask for a higher share of processor time for all present threads of this process.

    This is for work with a deadline that may occupy a processor for longer than a real-time thread
    should. Receiving threads are included: a frame waits for the answers that they receive.

    Args:
        niceness: below 0.

    Returns:
        A sentence for the log: the niceness, or the cause.
    """
    try:
        for thread in Path('/proc/self/task').iterdir():
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.setpriority(os.PRIO_PROCESS, int(thread.name), niceness)
    except PermissionError:
        return (
            'no preference over other processes is allowed for this user: allow it with "nice -20" '
            'in /etc/security/limits.d and log in again'
        )
    return f'preferred to other processes: niceness {niceness}'


@contextlib.contextmanager
def preferred_group() -> Iterator[None]:
    """Prefer the programs of this terminal to those of others, where that is allowed.

    Where the kernel shares processors between terminals and desktops first, a niceness counts only
    among processes of the same one (sched(7), "The autogroup feature"). A browser would then get as
    much as all nodes together.
    """
    before = _group_niceness()
    if before is not None:
        _set_group_niceness(FRAME_NICENESS)
    try:
        yield
    finally:
        if before is not None:
            _set_group_niceness(before)


def _group_niceness() -> int | None:
    try:
        return int(_GROUP.read_text().split()[-1])
    except (OSError, ValueError, IndexError):  # not by this kernel
        return None


def _set_group_niceness(niceness: int) -> None:
    for _ in range(2):
        try:
            _GROUP.write_text(str(niceness))
        except BlockingIOError:  # another one was set less than 0.1 s ago
            time.sleep(0.12)
        except OSError:  # it is not allowed
            return
        else:
            return
