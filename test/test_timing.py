"""Statistics of a loop for wake-ups worked out by hand, and which threads ask for preference."""

import threading

import pytest

from cutting_trainer.node_common import timing
from cutting_trainer.node_common.timing import Durations, PeriodicLoop, request_preference

MS = 1_000_000


class Clock:
    """A monotonic clock [ns] whose sleeps take longer than asked by what is in `late`."""

    def __init__(self) -> None:
        self.now, self.late = 10**12, [0]

    def monotonic_ns(self) -> int:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += round(seconds * 1e9) + self.late.pop(0)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(timing, 'time', clock)
    return clock


def ticks(loop: PeriodicLoop, clock: Clock, late: list[int], busy: int) -> None:
    clock.late = list(late)
    for number in range(1, len(late) + 1):
        loop.wait()
        clock.now += number * busy


def test_a_report_has_the_rate_lateness_and_work_of_each_period(clock: Clock) -> None:
    loop = PeriodicLoop(1000.0)
    loop.start()
    ticks(loop, clock, [0, MS // 5, 0, MS // 10], MS // 8)
    report = loop.report()
    assert (report['ticks'], report['missed']) == (4, 0)
    assert report['rate'] == pytest.approx(3 / 0.0031)
    assert report['period_max'] == pytest.approx(0.0012)
    assert report['period_p50'] == pytest.approx(0.0011)
    assert report['lateness_max'] == pytest.approx(0.0002)
    assert report['lateness_p50'] == pytest.approx(0.00005)
    assert report['busy_max'] == pytest.approx(0.000375)
    assert report['busy_p50'] == pytest.approx(0.00025)
    assert report['within'] == report['timely'] == 1.0


@pytest.mark.parametrize('begun', [0, MS // 3, 2 * MS // 3])
def test_loops_of_phases_half_a_period_apart_tick_half_a_period_apart(
    clock: Clock, begun: int
) -> None:
    moments = []
    for phase, at in ((0, 0), (1 / 2, begun), (2 / 2, begun)):
        clock.now, clock.late = 10**12 + at, [0]
        loop = PeriodicLoop(1000.0, phase=phase)
        loop.start()
        loop.wait()
        assert 0 < clock.now - 10**12 - at <= MS
        moments.append(clock.now % MS)
    assert moments == [0, MS // 2, 0]


def test_a_tick_that_oversleeps_misses_deadlines_and_makes_none_up(clock: Clock) -> None:
    loop = PeriodicLoop(1000.0)
    loop.start()
    ticks(loop, clock, [0, 0, 5 * MS // 2, 0], 0)
    report = loop.report()
    assert (report['ticks'], report['missed']) == (4, 2)
    assert report['timely'] == pytest.approx(3 / 6)
    assert report['within'] == pytest.approx(2 / 3)
    assert report['period_max'] == pytest.approx(0.0035)


def test_a_report_begins_where_the_last_one_ended_and_goes_back_by_the_window_at_most(
    clock: Clock,
) -> None:
    loop = PeriodicLoop(1000.0, window=4)
    loop.start()
    ticks(loop, clock, [MS // 5] * 5, 0)
    assert loop.report()['lateness_max'] == pytest.approx(0.0002)
    ticks(loop, clock, [MS // 10] * 3, 0)
    assert loop.report()['lateness_max'] == pytest.approx(0.0001)
    assert loop.report() == {'ticks': 8.0, 'missed': 0.0}
    ticks(loop, clock, [MS // 3, 0, 0, 0, 0], 0)
    assert loop.report()['lateness_max'] == 0.0


def test_durations_are_reported_once_by_their_quantiles() -> None:
    durations = Durations('wait', window=8)
    for value in (9, *range(1, 9)):
        durations.add(value * MS)
    report = durations.report()
    assert report['wait_max'] == pytest.approx(0.008)
    assert report['wait_p50'] == pytest.approx(0.0045)
    assert durations.report() == {}
    durations.add(3 * MS)
    assert durations.report()['wait_max'] == pytest.approx(0.003)


def test_preference_is_asked_for_every_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[int, int] = {}
    monkeypatch.setattr(
        timing.os, 'setpriority', lambda _which, who, niceness: asked.update({who: niceness})
    )
    over = threading.Event()
    other = threading.Thread(target=over.wait)
    other.start()
    try:
        assert '-7' in request_preference(-7)
        assert {threading.get_native_id(), other.native_id} <= asked.keys()
        assert set(asked.values()) == {-7}
    finally:
        over.set()
        other.join()
