"""Figures of the protection of the hand: E-STOP, floods, forged forces."""

import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from bench.figures.figure import Figure
from bench.flood import OFFERED_WORDS_PER_S, Flood
from cutting_trainer.haptic_bridge.force_kernels import INSIDE, MAX_SLEW_PERIOD_S, NONE, TOUCHING
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.proxy.surface import Surface
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    ToolSettings,
)
from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.cdr_codec import (
    ContactCodec,
    ForceSampleCodec,
    PoseStampedCodec,
    StampedMessage,
    WrenchStampedCodec,
)
from cutting_trainer.node_common.operating_state import (
    COMMANDS,
    E_STOP,
    AutoEnable,
    CrtkState,
    OperatingStateMachine,
    crtk_types,
)
from cutting_trainer.node_common.share_folder import PACKAGES
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.node_commands import node_environment

SEQUENCES, LENGTH = 3000, 40
"""Random sequences of commands, faults, restarts, E-STOPs and resets, and their steps."""
PRESSES, FLOOD = 100, 10_000
"""Presses of E-STOP, and words a second that the bridge acknowledges beside them."""
FLOOD_BEFORE_PRESS_S = 0.03
"""[s] of words before each press."""
COMMAND_TOPIC = 'haptic_bridge/state_command'
PLACES, SESSIONS, ANSWERS = ('free', 'touching', 'cutting'), 16, 21
"""Where forged forces are sent, sessions for each place, and forged answers in each: 1,008."""
HALF_EDGE_M, TOOL_RADIUS_M, STIFFNESS_N_PER_M, PRESS_DEPTH_M = 0.05, 0.004, 80.0, 5e-3
"""Half edge of the tissue [m], radius of the tool [m], stiffness [N/m], depth of a press [m]."""
PRESSES_TIMEOUT_S = 20.0
"""Timeout of the presses."""
_MS = 1_000_000
_UNIT = (0.0, 0.0, 0.0, 1.0)
_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
_CORNERS = np.array(
    [
        [-HALF_EDGE_M, -HALF_EDGE_M, 0],
        [HALF_EDGE_M, -HALF_EDGE_M, 0],
        [HALF_EDGE_M, HALF_EDGE_M, 0],
        [-HALF_EDGE_M, HALF_EDGE_M, 0],
    ]
)


def measure() -> list[Figure]:
    """Return the figures of lines 1, 2 and 3."""
    return [*_state_machine(), *_flood(), *_forged()]


def _state_machine() -> list[Figure]:
    rng = random.Random(1)
    wrong = sum(_runs_wrong(rng) for _ in range(SEQUENCES))
    name = 'sequences that are ENABLED after E-STOP without a reset'
    return [Figure(1, name, wrong, 0, 'at most', '', SEQUENCES)]


def _runs_wrong(rng: random.Random) -> bool:
    """Return whether a machine was ever ENABLED after E-STOP and before a reset, in a random
    sequence.
    """
    causes, fresh, stopped = [''], True, False
    machine = OperatingStateMachine(lambda: causes[-1])
    auto = AutoEnable(machine, wanted=True)
    for _ in range(LENGTH):
        event = rng.choice(('command', 'fault', 'world', 'time', 'stop', 'reset', 'again', 'dies'))
        if event == 'command':
            machine.command(rng.choice((*COMMANDS, 'no such')))
        elif event == 'fault':
            machine.fault('the cable is off')
        elif event == 'world':
            causes.append(rng.choice(('', 'no pose')))
            fresh = rng.random() < 0.7
        elif event == 'stop':
            machine.command(E_STOP)
            stopped = True
        elif event == 'reset' and rng.random() < 0.3:
            machine.reset()
            stopped = False
        elif event == 'again':
            machine.start_anew()
            auto = AutoEnable(machine, wanted=True)
        elif event == 'dies':
            machine = OperatingStateMachine(lambda: causes[-1], pressed=machine.e_stopped)
            auto = AutoEnable(machine, wanted=True)
        auto.look(lambda: fresh)  # noqa: B023 -- called before it changes
        if stopped and machine.state is not CrtkState.FAULT:
            return True
    return False


# Line 2: a bridge in a process of its own


class _World:
    """A device that presses on a flat tissue, and E-STOP."""

    def __init__(self, node: Any) -> None:
        from cutting_trainer_msgs.msg import ForceSample, Mesh
        from geometry_msgs.msg import PoseStamped, WrenchStamped
        from std_msgs.msg import Bool, Empty
        from std_srvs.srv import Trigger

        self.node, self.over = node, False
        make, types = node.create_publisher, crtk_types()
        self._poses = make(PoseStamped, f'{ros.ARM}/measured_cp', qos.STREAM)
        self._forces = make(ForceSample, ros.FORCE, qos.STREAM)
        self._meshes = make(Mesh, ros.MESH, qos.LATCHED)
        self._meshes.publish(_mesh(Mesh))
        self.word, self.empty = types.command, Empty
        self._commands = make(self.word, COMMAND_TOPIC, qos.EVENTS)
        self._presses = make(Empty, ros.E_STOP, qos.EVENTS)
        self._trigger = Trigger
        self._reset = node.create_client(Trigger, 'haptic_bridge/reset_e_stop')
        self._wrench = ros.polled(node, WrenchStamped, f'{ros.ARM}/servo_cf', qos.EVENTS)
        self._contact = ros.polled(node, _contact_type(), ros.CONTACT, qos.EVENTS)
        self.wrenches: list[tuple[int, float]] = []
        self.state, self.stopped = '', False
        hear = node.create_subscription
        hear(types.operating_state, 'haptic_bridge/operating_state', self._hear, qos.LATCHED)
        hear(Bool, 'haptic_bridge/e_stopped', self._hear_stop, qos.LATCHED)
        self._player = threading.Thread(target=self._play)
        self._player.start()

    def close(self) -> None:
        self.over = True
        self._player.join()

    def press(self) -> None:
        self._presses.publish(self.empty())

    def say(self, word: str) -> None:
        self._commands.publish(self.word(string=word))

    def reset(self) -> int:
        """Release E-STOP; return when the press was heard [ns]."""
        wait_for(self._reset.service_is_ready)
        answer = self._reset.call_async(self._trigger.Request())
        wait_for(answer.done)
        return int(answer.result().message.rpartition(' at ')[2].removesuffix(' ns'))

    def _hear(self, message: Any) -> None:
        self.state = message.state

    def _hear_stop(self, message: Any) -> None:
        self.stopped = message.data

    def _play(self) -> None:
        poses, forces = PoseStampedCodec('arm_base'), ForceSampleCodec('tissue')
        heard, ticks, due = None, 0, time.monotonic()
        while not self.over:
            pose = (0.01, -0.01, TOOL_RADIUS_M - PRESS_DEPTH_M, *_UNIT)
            self._poses.publish(poses.encode(time.time_ns(), pose))
            while (data := ros.take_raw(self._contact)) is not None:
                heard = ContactCodec().decode(data)
            while (data := ros.take_raw(self._wrench)) is not None:
                sample = WrenchStampedCodec().decode(data)
                self.wrenches.append((sample.stamp_ns, sample.values[2]))
            if ticks % 33 == 0 and heard is not None:
                self._forces.publish(forces.encode(time.time_ns(), _answer(ticks // 33, heard)))
            ticks += 1
            due += 1e-3
            time.sleep(max(due - time.monotonic(), 0.0))


def wait_for(condition: Callable[[], Any], seconds: float = 8.0) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError('the bridge did not reach the expected state')
        time.sleep(0.001)


def _contact_type() -> Any:
    from cutting_trainer_msgs.msg import Contact

    return Contact


def _mesh(kind: Any) -> Any:
    mesh = kind(topology=1, rest=_CORNERS.ravel().tolist(), displacement=[0.0] * 12)
    mesh.fixed, mesh.triangles, mesh.triangle_kind = [0] * 4, _TRIANGLES.ravel().tolist(), [0, 0]
    mesh.header.frame_id = ros.FRAME
    mesh.header.stamp = ros.stamp(time.time_ns())
    return mesh


def _answer(step: int, contact: StampedMessage) -> tuple[float, ...]:
    """Return the force sample of a tissue of `STIFFNESS_N_PER_M` in answer to a contact."""
    at = ContactCodec.fields
    sequence, state = contact.values[:2]
    device = contact.values[at['device']]
    depth = max(TOOL_RADIUS_M - device[2], 0.0) if state else 0.0
    head = (step + 1, 0, 1, sequence, *divmod(contact.stamp_ns, 10**9), state, *device)
    stiffness = STIFFNESS_N_PER_M if state else 0.0
    rest = (0.0, 0.0, 0.0, 0, *(0.0,) * 6)
    return (*head, 0.0, 0.0, STIFFNESS_N_PER_M * depth, *(0.0,) * 8, stiffness, *rest)


@contextmanager
def _bridge() -> Iterator[_World]:
    """Run a bridge in a process; yield its environment."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    with reserved_domain('free') as domain, tempfile.TemporaryDirectory() as folder:
        environment = node_environment(domain)
        scene = Path(folder) / 'flat.yaml'
        # The environment of the bridge may lack processor time for a while: that is no fault here.
        scene.write_text(
            f'tool: {{radius: {TOOL_RADIUS_M}, coupling_stiffness: 200}}\n'
            'device: {profile: dvrk_mtm}\n'
            'haptics: {soft_start: 0.0, device_timeout: 0.5, stale_after: 1.0}\n'
        )
        arguments = ['--ros-args', '-p', f'scene:={scene}', '-p', 'auto_enable:=true']
        process = subprocess.Popen(
            [sys.executable, '-m', 'cutting_trainer.haptic_bridge.node', *arguments],
            cwd=PACKAGES,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        before = {key: os.environ.get(key) for key in environment}
        os.environ.update(environment)
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=domain)
        node = rclpy.create_node('figures', context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        spinner = threading.Thread(target=executor.spin)
        spinner.start()
        world = _World(node)
        try:
            yield world
        finally:
            world.close()
            process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                process.wait(5.0)
            process.kill()
            process.wait()
            executor.shutdown()
            spinner.join()
            node.destroy_node()
            rclpy.shutdown(context=context)
            for key, value in before.items():
                if value is None:
                    os.environ.pop(key, None)
                else:
                    os.environ[key] = value


def _flood() -> list[Figure]:
    heard: list[int] = []
    felt = 0.5 * STIFFNESS_N_PER_M * PRESS_DEPTH_M
    with (
        _bridge() as world,
        closing(Flood(COMMAND_TOPIC, OFFERED_WORDS_PER_S, os.environ)) as flood,
    ):
        wait_for(lambda: world.state == 'ENABLED', 20.0)
        end = time.monotonic() + PRESSES_TIMEOUT_S
        for _ in range(PRESSES):
            with suppress(TimeoutError):
                wait_for(lambda: world.wrenches and world.wrenches[-1][1] > felt, 2.0)
            flood.begin()
            time.sleep(FLOOD_BEFORE_PRESS_S)
            world.press()
            with suppress(TimeoutError):
                wait_for(lambda: world.stopped, 1.0)
            flood.pause()
            if world.stopped:
                heard.append(world.reset())
            world.say('enable')
            with suppress(TimeoutError):
                wait_for(lambda: not world.stopped and world.state == 'ENABLED', 1.0)
            if time.monotonic() > end:
                break
        late = max((_nonzero(world.wrenches, at) for at in heard), default=PRESSES)
    beside = f'beside {flood.rate:.0f} words a second'
    words = 'words a second on state_command that the bridge acknowledges'
    return [
        Figure(2, words, flood.rate, FLOOD, 'at least', '/s', flood.acknowledged),
        Figure(2, f'E-STOPs heard {beside}', len(set(heard)), PRESSES, 'at least', '', PRESSES),
        Figure(2, 'forces from the tick that hears it on', late, 0, 'at most', '', PRESSES),
    ]


def _nonzero(wrenches: list[tuple[int, float]], heard: int) -> int:
    """Return how many forces in the 5 ms from the tick that heard a press on are not zero."""
    return sum(heard <= at < heard + 5 * _MS and bool(force) for at, force in wrenches)


# Line 3: the real force path, tick by tick


class _Hand:
    """A force path over a flat tissue; the tip at some height."""

    def __init__(self) -> None:
        self.profile = DeviceProfile(max_force=3.0, max_slew=500.0, max_stiffness=1000.0)
        haptics = HapticsSettings(soft_start=0.0, max_damping=0.0)
        tool = ToolSettings(radius=TOOL_RADIUS_M, coupling_stiffness=200.0)
        self.path = ForcePath(tool, DeviceSettings(), haptics, self.profile)
        self.now, self.step, self.ticks = 10**12, 0, 0
        self.surface = Surface(_CORNERS, _TRIANGLES, revision=0, topology=1)
        self.contact: tuple[float, ...] | None = None
        self.inside = False

    def tick(self, height: float, forged: StampedMessage | None = None) -> float:
        """Simulate a millisecond; return the norm of the force [N]."""
        self.now += _MS
        self.ticks += 1
        pose = StampedMessage(self.now, '', (0.01, -0.01, height, *_UNIT))
        sample = forged
        if sample is None and self.contact is not None and self.ticks % 33 == 0:
            self.step += 1
            heard = StampedMessage(self.now - _MS, '', self.contact)
            values = list(_answer(self.step, heard))
            if self.inside:
                values[ForceSampleCodec.fields['state']] = [INSIDE]
                values[ForceSampleCodec.fields['resistance']] = [0.3]
            sample = StampedMessage(self.now, 'tissue', tuple(values))
        out = self.path.tick(
            self.now, state=CrtkState.ENABLED, pose=pose, sample=sample, surface=self.surface
        )
        self.contact = out.contact
        return float(np.linalg.norm(out.wrench[:3]))


def _forged() -> list[Figure]:
    excess, free, count = -np.inf, 0.0, len(PLACES) * SESSIONS * ANSWERS
    for place in PLACES:
        for seed in range(SESSIONS):
            over, felt = _attack(np.random.default_rng(seed), place)
            excess = max(excess, over)
            free = max(free, felt) if place == 'free' else free
    allowed = 'stiffness known before x own distance + slew of 5 ms'
    return [
        Figure(3, f'largest excess over {allowed}', excess, 0.0, 'at most', 'N', count),
        Figure(3, 'largest force in free air', free, 0.0, 'at most', 'N', count // len(PLACES)),
    ]


def _attack(rng: np.random.Generator, place: str) -> tuple[float, float]:
    """Return the largest excess over the bound and the largest force [N], of one session."""
    hand = _Hand()
    height = {
        'free': 0.03,
        'touching': TOOL_RADIUS_M - PRESS_DEPTH_M,
        'cutting': TOOL_RADIUS_M - PRESS_DEPTH_M - 1e-3,
    }[place]
    for z in np.linspace(TOOL_RADIUS_M + 1e-3, height, 120):
        hand.tick(float(z))
    hand.inside = place == 'cutting'
    for _ in range(70):
        hand.tick(height)
    pace = 10 ** rng.uniform(np.log10(0.2), 3.0)
    between = max(1, min(round(1000 / pace), 50))
    slew = hand.profile.max_slew * MAX_SLEW_PERIOD_S
    excess, felt = -np.inf, 0.0
    for tick in range(ANSWERS * between):
        force = hand.tick(height, _forged_answer(rng, hand) if tick % between == 0 else None)
        bound = STIFFNESS_N_PER_M * max(TOOL_RADIUS_M - height, 0.0) + slew
        excess, felt = max(excess, force - bound), max(felt, force)
    return excess, felt


def _forged_answer(rng: np.random.Generator, hand: _Hand) -> StampedMessage:
    assert hand.contact is not None
    state = int(rng.choice([NONE, TOUCHING, INSIDE], p=[0.1, 0.4, 0.5]))
    step = hand.step + int(rng.choice([1, 2, 100, 10**6]))
    sequence = int(hand.contact[0]) - int(rng.integers(0, 40))
    head = (step, hand.step, 1 + int(rng.integers(0, 2)), sequence, *divmod(hand.now, 10**9), state)
    stiffness = np.eye(3) * rng.choice([0.0, 80.0, 1e3, 1e6])
    push = (0.0, 0.0, rng.choice([5.0, 50.0, 999.0]))
    values = (
        *(0.01, -0.01, 0.0),
        *push,
        *stiffness.ravel(),
        rng.choice([0.0, 1000.0]),
        0.0,
        0.0,
        0,
        *(0.1 * part for part in push),
        *(1.0, 0.5, 0.3),
    )
    return StampedMessage(hand.now, 'tissue', (*head, *map(float, values)))
