"""Messages as nobody should send them, to the force path: hypothesis makes them, the hand is safe.

What the running bridge does with such messages is in test_bridge_faults.py.
"""

import math
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rig import MS, PROFILE, RADIUS, UNIT, K, Rig, pressed

from cutting_trainer.haptic_bridge.proxy.surface import Surface
from cutting_trainer.haptic_bridge.tissue_sample import TissueSample
from cutting_trainer.node_common.cdr_codec import ForceSampleCodec, StampedMessage
from cutting_trainer.node_common.operating_state import CrtkState

DEPTH = 5e-3
ODD = st.one_of(
    st.sampled_from([math.nan, math.inf, -math.inf, 1e300, -1e300, 1e155, 5e-324, -0.0]),
    st.floats(),
)
_WHOLE = {
    'B': st.integers(0, 255),
    'i': st.integers(-(2**31), 2**31 - 1),
    'I': st.integers(0, 2**32 - 1),
    'Q': st.sampled_from([0, 1, 2**63 - 1, 2**63, 2**64 - 1]) | st.integers(0, 2**64 - 1),
}


@st.composite
def spoilt(draw):
    """Some fields of a `ForceSample`, each spoilt in one number: [(slot, value)]."""
    slots = []
    for name, code, count in ForceSampleCodec.layout:
        if draw(st.integers(0, 3)) == 0:
            slot = ForceSampleCodec.fields[name].start + draw(st.integers(0, count - 1))
            slots.append((slot, draw(ODD if code == 'd' else _WHOLE[code])))
    return slots


def check(rig: Rig, since: int) -> None:
    """What holds for every tick: finite, within the limits; faster to zero only at a FAULT."""
    forces = np.array(rig.forces[since - 1 :])
    assert np.isfinite(forces).all()
    assert all(np.isfinite(tick.contact).all() for tick in rig.ticks[since:])
    assert (np.linalg.norm(forces, axis=1) <= PROFILE.max_force + 1e-12).all()
    steps = np.linalg.norm(np.diff(forces, axis=0), axis=1)
    faulty = np.array([bool(tick.fault) for tick in rig.ticks[since:]])
    at_once = faulty & ~forces[1:].any(axis=1)
    assert (at_once | (steps <= PROFILE.max_slew * 1e-3 + 1e-9)).all()


@settings(deadline=None, max_examples=30)
@given(st.lists(spoilt(), min_size=1, max_size=3), st.booleans())
def test_no_tissue_force_makes_a_force_beyond_the_limits_or_passes_unseen(changes, inside):
    rig = pressed(ms=60)
    rig.inside, queue, seen = inside, list(changes), []

    def spoil(sample: StampedMessage) -> StampedMessage:
        if not queue:
            return sample
        values = list(sample.values)
        for slot, value in queue.pop():
            values[slot] = value
        whole = sample._replace(values=tuple(values))
        seen.append(TissueSample.read(whole).problem)
        return whole

    rig.spoil, start = spoil, len(rig.ticks)
    for _ in range(len(changes) + 1):
        rejected = rig.path.rejections.total
        rig.run(np.full(33, RADIUS - DEPTH))
        rig.state = CrtkState.ENABLED
        if seen and seen[-1]:
            assert rig.path.rejections.total > rejected
        seen.clear()
    check(rig, start)
    rig.inside = False
    rig.run(np.full(200, RADIUS + 2e-3))
    rig.state = CrtkState.ENABLED
    rig.run(np.linspace(RADIUS + 1e-3, RADIUS - DEPTH, 100))
    rig.run(np.full(70, RADIUS - DEPTH))
    assert rig.forces[-1][2] == pytest.approx(K * DEPTH, rel=1e-3)


@pytest.mark.parametrize(
    'field', [name for name, code, _ in ForceSampleCodec.layout if code == 'd']
)
@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, 1e300])
def test_a_number_that_cannot_be_is_a_fault_in_every_field_that_makes_the_force(field, value):
    rig = pressed(ms=60)
    slot = ForceSampleCodec.fields[field].start
    rig.spoil = lambda sample: sample._replace(
        values=(*sample.values[:slot], value, *sample.values[slot + 1 :])
    )
    rig.run(np.full(40, RADIUS - DEPTH))
    unused = field in ('kinetic_energy', 'elastic_energy')
    assert rig.state is (CrtkState.ENABLED if unused else CrtkState.FAULT)
    assert unused or field in next(tick.fault for tick in rig.ticks if tick.fault)
    assert unused == bool(np.any(rig.forces[-1]))


@pytest.mark.parametrize('state', [3, 255])
def test_a_contact_state_that_does_not_exist_is_a_fault(state):
    rig = pressed(ms=60)
    slot = ForceSampleCodec.fields['state'].start
    rig.spoil = lambda sample: sample._replace(
        values=(*sample.values[:slot], state, *sample.values[slot + 1 :])
    )
    rig.run(np.full(40, RADIUS - DEPTH))
    assert rig.state is CrtkState.FAULT


def test_a_blade_that_pushes_with_a_negative_resistance_is_a_fault():
    rig = pressed(ms=60)
    rig.inside = True
    slot = ForceSampleCodec.fields['resistance'].start
    rig.spoil = lambda sample: sample._replace(
        values=(*sample.values[:slot], -1.0, *sample.values[slot + 1 :])
    )
    rig.run(np.full(40, RADIUS - DEPTH))
    assert rig.state is CrtkState.FAULT
    assert not np.any(rig.forces[-1])


@settings(deadline=None, max_examples=60)
@given(
    st.lists(
        st.tuples(
            st.lists(st.tuples(st.integers(0, 6), ODD), max_size=3),
            st.sampled_from([0, 1, -1, 2**62, -(2**31) * 10**9]) | st.integers(-(10**10), 10**10),
        ),
        min_size=1,
        max_size=5,
    )
)
def test_no_pose_makes_a_force_beyond_the_limits(poses):
    rig = pressed(ms=60)
    start = len(rig.ticks)
    for changes, shift in poses:
        values = [0.0, 0.0, RADIUS - DEPTH, *UNIT]
        for slot, value in changes:
            values[slot] = value
        rig.tick(values[:3], values[3:], max(rig.now + MS + shift, 0) or None)
        rig.run(np.full(3, RADIUS - DEPTH))
        rig.state = CrtkState.ENABLED
    check(rig, start)


@settings(deadline=None, max_examples=40)
@given(
    st.lists(
        st.tuples(st.integers(0, 3), st.integers(0, 2), ODD | st.floats(-0.1, 0.1)), max_size=4
    )
)
def test_no_surface_makes_a_force_beyond_the_limits(changes):
    rig = pressed(ms=60)
    start = len(rig.ticks)
    nodes = rig.surface.geometry.end.copy()
    for node, axis, value in changes:
        nodes[node, axis] = value
    with suppress(ValueError):  # the node says it, and goes on with the one before
        rig.surface = Surface(nodes, rig.surface.geometry.triangles, revision=99, topology=2)
    rig.mesh = False
    rig.run(np.full(20, RADIUS - DEPTH))
    check(rig, start)
