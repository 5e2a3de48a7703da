"""Claims about the figures of `bench timing`."""

import json
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from bench.speed.timing import cyclictest_row, measured
from cutting_trainer.node_common.timing import (
    MAX_TIMELY_LATENESS_S,
    Durations,
    FairLock,
    PeriodicLoop,
)
from cutting_trainer.session.bag_measurements import Status

pytestmark = pytest.mark.long

CYCLICTEST = """\
# /dev/cpu_dma_latency set to 0us
# Histogram
000000 000000
000003 000500
000004 000497
000120 000002
# Total: 000000999
# Min Latencies: 00003
# Avg Latencies: 00004
# Max Latencies: 70000
# Histogram Overflows: 00001
# Histogram Overflow at cycle number:
# Thread 0: 00517

"""
"""As cyclictest 2.4 prints it with -q -h."""


def test_quantiles_of_cyclictest_are_those_of_its_histogram_with_what_overflowed():
    row = cyclictest_row(CYCLICTEST)
    assert (row.p50, row.p999, row.largest) == pytest.approx((3e-6, 120e-6, 0.07))
    assert row.timely == pytest.approx(0.999)
    assert cyclictest_row(CYCLICTEST.replace('00001\n', '00100\n')).p999 == np.inf


def test_a_run_is_the_median_of_its_seconds_and_its_worst_second():
    statuses = [
        Status(
            time,
            'haptic_bridge',
            0,
            '',
            {
                f'lateness_{key}': str(v * scale)
                for key, scale in (('p50', 1), ('p999', 5), ('max', 9))
            }
            | {'timely': str(1 - v / 100)},
        )
        for time, v in ((1.0, 99.0), (3.0, 2.0), (4.0, 3.0), (5.0, 8.0))
    ]
    (row,) = measured(statuses)
    assert (row.p50, row.p999, row.worst_p999, row.largest) == (3, 15, 40, 72)
    assert row.timely == pytest.approx(1 - 0.13 / 3)


def test_deadlines_that_a_loop_slept_through_were_not_met():
    loop = PeriodicLoop(200.0)
    loop.start()
    late = []
    for tick in range(20):
        late.append(loop.wait())
        if tick == 10:
            time.sleep(0.05)
    assert loop.missed >= 9
    timely = sum(ns <= MAX_TIMELY_LATENESS_S * 1e9 for ns in late) / (20 + loop.missed)
    assert loop.report()['timely'] == pytest.approx(timely)


def test_a_loop_that_never_rests_does_not_take_its_lock_again_before_who_waits_for_it():
    turns, ended, overtaken = FairLock(), threading.Event(), []
    held = 0

    def work() -> None:
        nonlocal held
        while not ended.is_set():
            with turns:
                held += 1
                time.sleep(0.002)

    loop = threading.Thread(target=work)
    loop.start()
    for _ in range(21):
        time.sleep(0.005)  # so that the loop has it now
        before = held
        with turns:
            overtaken.append(held - before)
    ended.set()
    loop.join()
    assert np.median(overtaken) == 0  # the machine may stand still before this thread asks


def test_durations_are_reported_once():
    durations = Durations('wait', window=100)
    for value in range(1, 201):
        durations.add(value * 1_000_000)
    report = durations.report()
    assert report['wait_p50'] == pytest.approx(0.1505)
    assert report['wait_max'] == pytest.approx(0.2)
    assert durations.report() == {}


def test_the_bare_loop_says_how_late_it_woke():
    done = subprocess.run(
        [sys.executable, '-m', 'bench.speed.reference_loop', '0.3'],
        capture_output=True,
        text=True,
        check=True,
    )
    report = json.loads(done.stdout)
    assert report['ticks'] + report['missed'] == pytest.approx(300, abs=100)
    assert 0 <= report['lateness_p50'] <= report['lateness_p999'] <= report['lateness_max']
