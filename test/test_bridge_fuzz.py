"""Messages as nobody should send them, on every topic that the running bridge hears.

Hypothesis makes them; one bridge process gets them all. What the force path does with each number
is in test_hostile_messages.py.
"""

import math
import time
from collections import deque
from collections.abc import Callable

import numpy as np
import pytest
from bridge_world import DEPTH, PRESSED, K, Record, World, messages, refused, session
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from live import free_domain
from sensor_msgs.msg import Joy

from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings
from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.cdr_codec import ForceSampleCodec, PoseStampedCodec, StampedCodec

pytestmark = [pytest.mark.real_time, pytest.mark.thorough]

SCENE = """
tool: {radius: 0.004, coupling_stiffness: 200}
device: {profile: dvrk_mtm, hold_button: true}
haptics: {soft_start: 0.1, device_timeout: 0.2}
"""
PROFILE = DeviceSettings(profile='dvrk_mtm').load_profile()
EXAMPLES = 120
PAUSE = 0.02
"""[s] that a hostile message has to act."""
TOPICS = ('pose', 'force', 'mesh', 'updates', 'command', 'button', 'device')
ODD = st.sampled_from([math.nan, math.inf, -math.inf, 1e300, -1e300, 1e9, -0.0]) | st.floats()
COUNT = st.sampled_from([0, 1, 4, 5, 2**31, 2**32 - 1])
BIG = st.sampled_from([0, 1, 2**63, 2**64 - 1])
FRAMES = st.sampled_from([ros.FRAME, ros.FRAME, '', 'arm_base', 'x' * 300])


class HostileWorld(World):
    """A world that now and then says what it should not, by the publishers that it has."""

    def __init__(self, record: Record) -> None:
        self.hostile: deque = deque()
        super().__init__(record)
        make = self.node.create_publisher
        self.button = make(Joy, 'arm/button', qos.EVENTS)
        self.device = make(self.state.msg_type, 'arm/operating_state', qos.LATCHED)

    def send_pose(self, now: int, tick: int) -> None:
        while self.hostile:
            topic, message = self.hostile.popleft()
            getattr(self, topic).publish(message)
        super().send_pose(now, tick)

    def be_good(self) -> None:
        """Undoes what a hostile message may have asked for."""
        self.button.publish(Joy(buttons=[1]))
        self.device.publish(self.state.msg_type(state='ENABLED', is_homed=True))
        state = self.record.states[-1][1]
        if state != 'ENABLED':
            self.command.publish(self.message(string='resume' if state == 'PAUSED' else 'enable'))


@st.composite
def stamped(draw: st.DrawFn, codec: type[StampedCodec], good: Callable[[], list]) -> bytes:
    """A message of the fast loop with some numbers, the stamp or the frame spoilt."""
    values = good()
    for name, code, count in codec.layout:
        slot = codec.fields[name].start + draw(st.integers(0, count - 1))
        if draw(st.integers(0, 3)) == 0:
            bits = {'B': 8, 'i': 31, 'I': 32, 'Q': 64}.get(code)
            values[slot] = draw(st.integers(0, 2**bits - 1) if bits else ODD)
    now = time.time_ns() if draw(st.booleans()) else draw(st.integers(0, 2**31 - 1)) * 10**9
    return codec(draw(FRAMES)).encode(now, values)


@st.composite
def surfaces(draw: st.DrawFn, kind: type) -> object:
    """A `Mesh` or `MeshDelta` of which hardly anything fits."""
    message = kind(revision=draw(BIG), topology=draw(BIG), step=draw(BIG))
    message.header.frame_id = draw(FRAMES)
    message.header.stamp.sec = draw(st.integers(-(2**31), 2**31 - 1))
    for name, field in message.get_fields_and_field_types().items():
        if field == 'sequence<double>':
            setattr(message, name, draw(st.lists(ODD, max_size=12)))
        elif field == 'sequence<uint32>':
            setattr(message, name, draw(st.lists(COUNT, max_size=12)))
        elif field == 'sequence<uint8>':
            setattr(message, name, draw(st.lists(st.integers(0, 255), max_size=4)))
        elif field == 'uint32':
            setattr(message, name, draw(COUNT))
    return message


def hostile(world: HostileWorld) -> st.SearchStrategy:
    """(topic, message or bytes) for every topic that the bridge hears."""

    def pose() -> list:
        return [*world.place, PRESSED, 0.0, 0.0, 0.0, 1.0]

    def force() -> list:
        """The next frame: what is older is not looked at."""
        return [world.revision + 1] + [0] * (
            sum(count for _, _, count in ForceSampleCodec.layout) - 1
        )

    words = st.sampled_from(['disable', 'pause', 'unhome', 'home']) | st.text(max_size=50)
    state = st.builds(
        world.state.msg_type,
        state=st.sampled_from(['FAULT', 'DISABLED', 'PAUSED', 'UNDEFINED', '', 'enabled']),
        is_homed=st.booleans(),
    )
    numbers = st.lists(st.integers(-(2**31), 2**31 - 1), max_size=3)
    made = {
        'pose': stamped(PoseStampedCodec, pose),
        'force': stamped(ForceSampleCodec, force),
        'mesh': surfaces(messages.Mesh),
        'updates': surfaces(messages.MeshDelta),
        'command': st.builds(world.message, string=words),
        'button': st.builds(Joy, buttons=numbers, axes=st.lists(st.floats(width=32), max_size=2)),
        'device': state,
    }
    # No bytes at all are no message: Fast DDS never delivers them, nor what comes after.
    garbage = st.binary(min_size=4, max_size=40) | st.binary(max_size=40).map(
        lambda b: b'\0\1\0\0' + b
    )
    return st.one_of(
        *(st.tuples(st.just(topic), strategy) for topic, strategy in made.items()),
        st.tuples(st.sampled_from(TOPICS), garbage),
    )


def play(world: HostileWorld, record: Record) -> None:
    """The session that all tests of this file look at."""
    world.wait_until(lambda: bool(record.states), 60.0)

    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(st.lists(hostile(world), min_size=1, max_size=2))
    def attack(barrage: list) -> None:
        world.hostile.extend(barrage)
        time.sleep(PAUSE)
        world.be_good()

    world.be_good()
    world.wait_for('ENABLED', 60.0)
    world.move(PRESSED, 0.2)
    attack()
    world.height = 0.02
    time.sleep(1.5)  # as long as two publishers are remembered
    world.be_good()
    world.wait_for('ENABLED', 10.0)
    world.move(PRESSED, 0.2)
    record.marks['pressed again'] = time.time_ns()
    time.sleep(1.2)
    record.marks['end'] = time.time_ns()


@pytest.fixture(scope='module')
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    scene = tmp_path_factory.mktemp('fuzz') / 'flat.yaml'
    scene.write_text(SCENE)
    return session(scene, free_domain(), play, HostileWorld)


def test_every_force_is_finite_and_within_the_limits_of_the_device(record: Record) -> None:
    forces = np.array([w.values[:3] for w in record.wrenches])
    times = np.array([w.stamp_ns for w in record.wrenches]) / 1e9
    assert np.isfinite(forces).all()
    assert forces.any()
    assert np.linalg.norm(forces, axis=1).max() <= PROFILE.max_force
    steps = np.linalg.norm(np.diff(forces, axis=0), axis=1)
    faster = steps > PROFILE.max_slew * np.clip(np.diff(times), 1e-4, 5e-3) + 1e-3
    assert not forces[1:][faster].any()


def test_the_bridge_lives_hears_and_gives_the_right_force_afterwards(record: Record) -> None:
    back = record.forces('pressed again', 0.7, before='end')
    np.testing.assert_allclose(np.median(back), K * DEPTH, rtol=1e-2)
    assert record.marks['exit status'] == 0


def test_what_was_refused_was_said(record: Record) -> None:
    said = ' '.join(record.said)
    for word in ('message of the simulation', 'the device says that it is', 'frame_id'):
        assert word in said
    assert refused(record.statuses[-1]) > 0
