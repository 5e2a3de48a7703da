"""Sessions on the real graph: the launcher as a process, and what the bag has to say about it.

Every process of a session carries the path of its scene in its command line, and each session has
a scene file of its own: so are its processes found, and no others.
"""

import contextlib
import itertools
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from ruamel.yaml import YAML

from cutting_trainer.bags.reader import Recorded, open_bag
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, HapticsSettings
from cutting_trainer.node_common.cdr_codec import ForceSampleCodec, WrenchStampedCodec
from cutting_trainer.node_common.qos import NEWEST_BEST_EFFORT
from cutting_trainer.node_common.ros import polled, take_raw
from cutting_trainer.session.domain import MAX_DOMAIN, has_participants, reserved_domain
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import MODULES, VIEWER_NODE

ROOT = Path(__file__).parents[1]
NODES = tuple(name for name in MODULES if name != VIEWER_NODE)
"""Of a session that nobody watches."""
PATIENCE = 240.0
"""[s] for what has no deadline: a machine may give a session no turn for a while."""
COMPLAINT = 'not as it should be: '
SERVO_CF, MEASURED_CF, MEASURED_CP = '/arm/servo_cf', '/arm/measured_cf', '/arm/measured_cp'
CONTACT, TISSUE_FORCE = '/tool/contact', '/tissue/force'
ABOVE, PRESSED, EASED = 0.0190, 0.0110, 0.0125
"""Heights of the tip [m] over the block, of which the surface is at 10 mm and the radius 4 mm."""
SPOT = (-0.012, -0.008)
PRESSING = 0.07
"""[N] that says that the hand is down; at rest there it feels a little more."""
HAPTICS = HapticsSettings()
PROFILE = DeviceSettings().load_profile()
FRAME = 1 / 30
"""[s] between two frames of the tissue."""
WORKER = int(os.environ.get('PYTEST_XDIST_WORKER', 'gw0').removeprefix('gw'))
WORKERS = int(os.environ.get('PYTEST_XDIST_WORKER_COUNT', '1'))
DOMAINS = itertools.cycle(range(MAX_DOMAIN - WORKER, MAX_DOMAIN // 2, -WORKERS))
STEADY = 0.3
"""[s] after which a force that stays counts as steady."""


def phase(kind: str, *points: tuple[float, float, float, float], share: float = 1.0) -> Any:
    """A phase of a script; points are x, y, z [m] and their share of the phase."""
    waypoints = [{'position': list(point[:3]), 'share': point[3]} for point in points]
    return {'kind': kind, 'share': share, 'waypoints': waypoints}


def two_presses() -> list[Any]:
    """Presses, eases, presses just as deep again, in seven seconds: the hands rests in both."""
    press = [(*SPOT, PRESSED, 0.6), (*SPOT, PRESSED, 1.5)]
    return [
        phase('approach', (*SPOT, ABOVE, 1.0), share=1.0),
        phase('palpate', *press, (*SPOT, EASED, 0.5), *press, share=4.7),
        phase('retract', (*SPOT, ABOVE, 1.0), share=1.3),
    ]


def write_scene(
    folder: Path,
    phases: list[Any],
    seconds: float,
    cut_threshold: float,
    method: str = 'delete',
    contact: str = 'footprint',
    mesh: Path = ROOT / 'config' / 'meshes' / 'block_yi2007.msh',
) -> Path:
    """A scene of the block of the thesis, of liver as stiff as it is in the body."""
    source = ROOT / 'config' / 'scenes' / 'block.yaml'
    scene = YAML(typ='safe').load(source)
    tissue = scene['tissue']
    tissue['mesh'] = str(mesh)
    tissue['material'] = {'preset': 'liver_elastography', 'toughness': 20, 'blade_friction': 5}
    tissue['damping'] = {'alpha': 10, 'beta': 1e-3}
    tissue['cut_threshold'], tissue['contact'] = cut_threshold, contact
    scene['cutting'] = {'method': method}
    scene['arm']['script']['start']['position'] = [*SPOT, 0.030]
    scene['arm']['script'] |= {'seconds': seconds, 'phases': phases}
    scene['session']['seconds'] = seconds
    # A shared machine may stand still for longer than the 20 ms that make a silent device a fault;
    # that deadline has tests of its own (test_bridge_node.py).
    scene['haptics'] = {**scene.get('haptics', {}), 'device_timeout': 0.2}
    path = folder / 'scene.yaml'
    with path.open('w') as file:
        YAML().dump(scene, file)
    return path


@contextmanager
def running(
    command: Sequence[str], environment: Mapping[str, str], ready: str = ''
) -> Iterator['subprocess.Popen[str]']:
    """Runs a program, of which one of the first lines is `ready`; kills it at the end."""
    with subprocess.Popen(
        command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            assert not ready or f'{ready}\n' in process.stdout
            yield process
        finally:
            process.kill()


def node_words(module: str, *arguments: str) -> list[str]:
    """The command of a node, without its interpreter's environment."""
    return [sys.executable, '-m', module, '--ros-args', *arguments]


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    """Waits for a condition to be true, and returns it."""
    deadline = time.monotonic() + PATIENCE
    while not (value := condition()):
        assert time.monotonic() < deadline, f'waited in vain for {what}'
        time.sleep(0.01)
    return value


def free_domain() -> int:
    """A ROS domain that nobody uses, of those that belong to this process of the tests.

    Sessions with `--domain free` take the lowest one, and keep it from others.
    """
    for domain in itertools.islice(DOMAINS, MAX_DOMAIN):
        if not has_participants(domain):
            with contextlib.suppress(SessionError), reserved_domain(domain):
                return domain
    raise AssertionError('no ROS domain is free')


@contextmanager
def onlooker(domain: int, kind: Any = WrenchStamped, topic: str = SERVO_CF) -> Iterator[Any]:
    """A subscription in this process, to be polled; to the commanded force unless it is said."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node('onlooker', context=context)
    try:
        yield polled(node, kind, topic, NEWEST_BEST_EFFORT)
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


class LiveSession:
    """`trainer demo` as its own process.

    Args:
        folder: for the bag and what the launcher says.
        scene: file of its own.
        domain: ROS domain.
    """

    def __init__(self, folder: Path, scene: Path, domain: int) -> None:
        self.bag = folder / 'bag'
        self.domain = domain
        self.scene = scene
        self._said = folder / 'said'
        command = [
            sys.executable,
            '-m',
            'cutting_trainer.cli.main',
            'demo',
            '--domain',
            str(domain),
        ]
        with self._said.open('wb') as file:
            self.launcher = subprocess.Popen(
                [*command, '--scene', str(scene), '--bag', str(self.bag)],
                cwd=ROOT,
                env=os.environ | {'COLUMNS': '200'},
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    @property
    def said(self) -> str:
        """Everything that the launcher has printed."""
        return self._said.read_text()

    def running(self) -> dict[str, int]:
        """Process ids of the session by node; `launcher` for the command itself."""
        found = {}
        for entry in Path('/proc').iterdir():
            try:
                words = (entry / 'cmdline').read_bytes().decode().split('\0')
                state = (entry / 'stat').read_text().rpartition(')')[2].split()[0]
            except (OSError, UnicodeDecodeError):
                continue
            if state != 'Z' and any(str(self.scene) in word for word in words):
                names = [name for name, module in MODULES.items() if module in words]
                found[names[0] if names else 'launcher'] = int(entry.name)
        return found

    def wait_until_said(self, text: str) -> None:
        """Returns when the launcher has printed this."""
        deadline = time.monotonic() + PATIENCE
        while text not in self.said and self.launcher.poll() is None:
            assert time.monotonic() < deadline, f'waited in vain for {text}: {self.said}'
            time.sleep(0.01)
        assert text in self.said, self.said

    def wait_until_pressed(self, least: float, tool: str = '') -> None:
        """Returns when the force on the hand of a tool [N] has stayed above a value for a while."""
        rest = -np.inf
        with onlooker(self.domain, topic=tool + SERVO_CF) as forces:

            def pressed() -> bool:
                nonlocal rest
                assert self.launcher.poll() is None, self.said
                raw, now = take_raw(forces), time.monotonic()
                felt = raw and np.linalg.norm(WrenchStampedCodec().decode(raw).values[:3])
                if felt is not None and felt < least:
                    rest = now
                return felt is not None and now - rest > STEADY

            wait_for(lambda: take_raw(forces), 'the first force')
            rest = time.monotonic()
            wait_for(pressed, 'the hand to press')

    def command(self, node: str) -> list[str]:
        """Program and arguments of a node that runs."""
        line = Path(f'/proc/{self.running()[node]}/cmdline').read_bytes().decode()
        return line.rstrip('\0').split('\0')

    def interrupt(self) -> None:
        """What Ctrl-C does."""
        os.kill(self.launcher.pid, signal.SIGINT)

    def kill(self, node: str) -> int:
        """Kills a node; returns when, [ns] since the epoch."""
        process = self.running()[node]
        now = time.time_ns()
        os.kill(process, signal.SIGKILL)
        return now

    def end(self) -> int:
        """Waits for the launcher's end; returns its exit status."""
        return self.launcher.wait(PATIENCE)

    def complaints(self) -> list[str]:
        """Waits for the launcher's end; returns its complaints.

        A rate that the machine did not give is none: no test asserts a speed.
        """
        status = self.end()
        said = [line for line in self.said.splitlines() if COMPLAINT in line]
        assert status in (Status.OK, Status.FAILED) and bool(said) == (status != Status.OK), (
            self.said
        )
        return [line for line in said if ' ran at ' not in line]

    def clean(self) -> None:
        """Kills what is left over."""
        for process in self.running().values():
            os.kill(process, signal.SIGKILL)
        self.launcher.wait(PATIENCE)


class Recording:
    """A bag in memory. Times are [s] by the stamp in the header, since the first message.

    Attributes:
        bag: to read messages with.
        complete: whether the bag was closed in order.
        start: when the first message was recorded [ns since the epoch].
    """

    def __init__(self, folder: Path) -> None:
        self.bag = bag = open_bag(folder)
        self.complete = bag.complete
        self._messages: dict[str, list[Recorded]] = {topic: [] for topic in bag.topics()}
        self.start = 0
        for message in bag.messages():
            self.start = self.start or message.log_time
            self._messages[message.topic].append(message)

    def at(self, nanoseconds: int) -> float:
        """A time of the system clock as one of this recording [s]."""
        return (nanoseconds - self.start) * 1e-9

    def messages(self, topic: str) -> list[Recorded]:
        """All of a topic, in the order of their arrival."""
        return self._messages.get(topic, [])

    def read(self, topic: str, codec: Any, *fields: str) -> tuple[np.ndarray, ...]:
        """Times [s], shape (n,), and each field, shape (n, count)."""
        samples = [codec.decode(message.data) for message in self.messages(topic)]
        times = np.array([self.at(sample.stamp_ns) for sample in samples])
        values = [np.array([s.values[codec.fields[name]] for s in samples]) for name in fields]
        return times, *values

    def force(self, topic: str) -> tuple[np.ndarray, np.ndarray]:
        """Times [s] and norm of the force [N], shape (n,)."""
        times, forces = self.read(topic, WrenchStampedCodec(), 'force')
        return times, np.linalg.norm(forces, axis=1)


def zero_from(times: np.ndarray, norms: np.ndarray) -> float:
    """Since when [s] the force has been zero to the end; infinite if it is not."""
    nonzero = np.flatnonzero(norms)
    last = nonzero[-1] + 1 if len(nonzero) else 0
    return float(times[last]) if last < len(times) else np.inf


def worst_gap(times: np.ndarray, start: float, end: float) -> float:
    """The longest time [s] from a sample of an interval to the next: the scheduler's, of 1 ms."""
    within = (times[:-1] > start) & (times[:-1] < end)
    return float(np.diff(times)[within].max())


def held_up(recording: Recording, times: np.ndarray) -> np.ndarray:
    """When, of the times [s], the force was low because the tissue's process had no turn.

    The force fades while frames are overdue, and is let in softly after that.
    """
    frames, _ = recording.read(TISSUE_FORCE, ForceSampleCodec(), 'step')
    late = np.flatnonzero(np.diff(frames) > HAPTICS.stale_after - FRAME)
    held = np.zeros(len(times), bool)
    for gap in late:
        end = frames[gap + 1] + HAPTICS.soft_start + 2 * FRAME
        held |= (times > frames[gap] + HAPTICS.stale_after - FRAME) & (times < end)
    return held


def require_limits(recording: 'Recording') -> None:
    """Every commanded force is finite and within the device's norm and slew; or zero at once."""
    times, forces = recording.read(SERVO_CF, WrenchStampedCodec(), 'force')
    assert np.isfinite(forces).all()
    assert np.linalg.norm(forces, axis=1).max() <= PROFILE.max_force
    steps = np.linalg.norm(np.diff(forces, axis=0), axis=1)
    faster = steps > PROFILE.max_slew * np.clip(np.diff(times), 1e-4, 5e-3) + 1e-3
    assert not forces[1:][faster].any()


def deaths(said: str) -> list[str]:
    """Who died, in the words of the launcher."""
    return re.findall(r'^(\w+) died after [\d.]+ s \(killed by SIGKILL\); .* go on$', said, re.M)
