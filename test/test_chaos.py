"""Nodes of a session are killed and frozen at random: the hand is safe, and all comes back."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from live import PROFILE, ROOT

from bench.trials.chaos_verdict import (
    Fault,
    Observations,
    force_failures,
    lost_cuts,
    not_recovered,
)
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.restart_backoff import (
    HEALTHY_AFTER_S,
    INITIAL_DELAY_S,
    MAX_DELAY_S,
    Backoff,
)

LEVEL = 1.0
"""[N] that is commanded all the time."""


def steady(until: float = 10.0) -> Observations:
    """A hand that presses, everything being well; a frame comes thirty times a second."""
    times = np.arange(0.0, until, 1e-3)
    rows = [(t, t, LEVEL, 0.0, 0.0) for t in times.tolist()]
    frames = np.arange(0.0, until, 1 / 30).tolist()
    return Observations(list(rows), list(rows), frames, [], [], [(t, 3) for t in frames])


def without(seen: Observations, start: float, end: float, *what: str) -> Observations:
    """The same, but for some of the messages from one time to another."""
    kept = {
        name: [
            x for x in getattr(seen, name) if not start < (x if name == 'samples' else x[0]) < end
        ]
        for name in what
    }
    return replace(seen, **kept)


def forceless(seen: Observations, start: float, end: float, *what: str) -> Observations:
    """The same, without force from one time to another."""
    changed = {
        name: [(t, s, 0.0 if start < t < end else x, y, z) for t, s, x, y, z in getattr(seen, name)]
        for name in what
    }
    return replace(seen, **changed)


def test_a_session_without_faults_is_safe() -> None:
    assert force_failures(steady(), [], PROFILE) == []


def test_an_arm_that_holds_a_dead_bridge_s_force_is_found() -> None:
    seen = replace(without(steady(), 4.0, 7.0, 'commanded'), enabled=[4.5])
    fault = Fault('kill', 'haptic_bridge', 4.0, 6.0)
    (found,) = force_failures(seen, [fault], PROFILE)
    assert 'the arm held 1 N more than 30 ms after the kill of haptic_bridge' in found
    assert force_failures(forceless(seen, 4.03, 7.0, 'felt'), [fault], PROFILE) == []


def test_a_bridge_that_holds_a_dead_simulation_s_force_is_found() -> None:
    seen = without(steady(), 4.0, 7.0, 'samples')
    fault = Fault('freeze', 'tissue_sim', 4.0, 7.0)
    (found,) = force_failures(seen, [fault], PROFILE)
    assert 'the bridge held 1 N more than 150 ms after the freeze of tissue_sim' in found
    assert force_failures(forceless(seen, 4.15, 10.0, 'commanded'), [fault], PROFILE) == []


def test_a_force_that_is_heard_before_the_word_that_it_follows_is_not_held() -> None:
    seen = without(steady(), 4.0, 6.0, 'samples')  # the next one: at 6.0 s
    fault = Fault('freeze', 'tissue_sim', 4.0, 5.95)

    def held(seen: Observations) -> bool:
        return any('held' in found for found in force_failures(seen, [fault], PROFILE))

    assert not held(forceless(seen, 4.15, 5.995, 'commanded'))
    assert held(forceless(seen, 4.15, 5.98, 'commanded'))
    # The listener stood still, and then heard all at once.
    assert not held(without(forceless(seen, 4.15, 5.96, 'commanded'), 5.9, 5.96, 'commanded'))


def test_a_simulation_that_is_asked_to_end_may_finish_and_no_force_outlives_its_last_word() -> None:
    seen = without(steady(), 4.25, 7.0, 'samples')  # its last one: at 4.233 s
    fault = Fault('end', 'tissue_sim', 4.0, 7.0)
    assert force_failures(forceless(seen, 4.35, 10.0, 'commanded'), [fault], PROFILE) == []
    (found,) = force_failures(forceless(seen, 4.42, 10.0, 'commanded'), [fault], PROFILE)
    assert 'the bridge held 1 N more than 150 ms after the end of tissue_sim' in found
    killed = Fault('kill', 'tissue_sim', 4.0, 7.0)  # and said nothing more
    seen = without(steady(), 4.01, 7.0, 'samples')
    assert force_failures(forceless(seen, 4.35, 10.0, 'commanded'), [killed], PROFILE)


def test_a_new_bridge_that_enables_itself_is_found() -> None:
    seen = forceless(without(steady(), 4.0, 6.0, 'commanded'), 4.03, 6.0, 'felt')
    fault = Fault('kill', 'haptic_bridge', 4.0, 6.0)
    (found,) = force_failures(seen, [fault], PROFILE)
    assert 'unasked' in found
    assert force_failures(replace(seen, enabled=[5.9]), [fault], PROFILE) == []


@pytest.mark.parametrize(
    ('force', 'said'),
    [(np.nan, 'not finite'), (PROFILE.max_force * 1.01, 'above the'), (-LEVEL, 'further in')],
)
def test_one_unsafe_command_is_found(force: float, said: str) -> None:
    seen = steady()
    seen.commanded[5000] = (5.0, 5.0, force, 0.0, 0.0)
    assert any(said in found for found in force_failures(seen, [], PROFILE))


def test_motors_that_anybody_commands_may_give_what_they_have() -> None:
    seen = steady()
    seen.felt[5000] = (5.0, 5.0, 1.2 * PROFILE.max_force, 0.0, 0.0)
    assert force_failures(seen, [], PROFILE)
    assert force_failures(seen, [], PROFILE, 1.2 * PROFILE.max_force) == []
    assert force_failures(seen, [], PROFILE, 1.1 * PROFILE.max_force)


def test_a_tissue_that_closes_again_and_a_node_that_stays_away_are_found() -> None:
    seen = steady()
    seen.topologies[100] = (3.3, 2)
    assert len(lost_cuts(seen)) == 1
    assert (
        len(not_recovered([Fault('end', 'cutting', 1.0, 40.0), Fault('kill', 'cutting', 1, 5)]))
        == 1
    )


def test_a_node_is_started_again_later_and_later_and_soon_after_a_healthy_life() -> None:
    backoff, now, delays = Backoff(), 0.0, []
    for _ in range(9):
        backoff.started(now)
        delays.append(backoff.died(now + 1.0))
        now += 1.0 + delays[-1]
    assert delays[:3] == [INITIAL_DELAY_S, 2 * INITIAL_DELAY_S, 4 * INITIAL_DELAY_S]
    assert delays[-1] == MAX_DELAY_S
    backoff.started(now)
    assert backoff.died(now + HEALTHY_AFTER_S + 1.0) == INITIAL_DELAY_S


@pytest.mark.thorough
@pytest.mark.real_time
def test_faults_leave_the_hand_safe_and_the_session_whole(tmp_path: Path) -> None:
    command = [
        sys.executable,
        '-m',
        'bench',
        'chaos',
        '--minutes',
        '2',
        '--faults',
        '25',
    ]
    done = subprocess.run(
        [*command, '--bag', str(tmp_path / 'bag'), '--json'],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=400,
    )
    outcome = json.loads(done.stdout)
    assert outcome['failures'] == []
    assert done.returncode == Status.OK
    assert outcome['faults'] >= 25
    assert outcome['changes by cuts'] > 0
