"""Every node configures, activates, rests, cleans up and shuts down when it is told to."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('rclpy')

import rclpy
from geometry_msgs.msg import WrenchStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from live import PATIENCE, ROOT, free_domain, two_presses, wait_for, write_scene
from rclpy.node import Node

from cutting_trainer.node_common.cdr_codec import WrenchStampedCodec
from cutting_trainer.node_common.qos import NEWEST_BEST_EFFORT
from cutting_trainer.node_common.ros import polled, take_raw
from cutting_trainer.session.node_commands import MODULES, node_environment
from cutting_trainer.session.supervisor import EXPECTED_STATUSES

pytestmark = pytest.mark.long


class Manager:
    """A lifecycle manager of one node, which runs as a process of its own."""

    def __init__(self, name: str, scene: Path, folder: Path, domain: int) -> None:
        self._said: str | None = None
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = Node('manager', context=self.context)
        self._executor = rclpy.executors.SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        own = {'recorder': ['-p', f'bag:={folder / "bag"}'], 'viewer': ['-p', 'port:=0']}
        arguments = ['--ros-args', '-p', f'scene:={scene}', '-p', 'autostart:=false']
        self.process = subprocess.Popen(
            [sys.executable, '-m', MODULES[name], *arguments, *own.get(name, [])],
            cwd=ROOT,
            env=node_environment(domain),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._change = self.node.create_client(ChangeState, f'{name}/change_state')
        self._get = self.node.create_client(GetState, f'{name}/get_state')
        wait_for(self._get.service_is_ready, f'{name} to be there')

    def _ask(self, client: Any, request: Any) -> Any:
        future = client.call_async(request)
        self._executor.spin_until_future_complete(future, PATIENCE)
        return future.result()

    def change(self, transition: int) -> str:
        """Asks for a transition, and returns the state that the node is in then."""
        request = ChangeState.Request(transition=Transition(id=transition))
        assert self._ask(self._change, request) is not None
        return self.state()

    def state(self) -> str:
        answer = self._ask(self._get, GetState.Request())
        return str(answer.current_state.label)

    def close(self) -> str:
        if self._said is not None:
            return self._said
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)
        self.process.kill()
        self._said = self.process.communicate()[0]
        return self._said


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path


@pytest.fixture
def managers(folder: Path) -> Iterator[Any]:
    made: list[Manager] = []
    scene = write_scene(folder, two_presses(), 7.0, 100.0)
    domain = free_domain()

    def make(name: str, path: Path = scene) -> Manager:
        made.append(Manager(name, path, folder, domain))
        return made[-1]

    yield make
    for manager in made:
        print(manager.close())


@pytest.mark.parametrize('name', MODULES)
def test_node_goes_through_its_life_and_a_second_one(managers: Any, name: str) -> None:
    node = managers(name)
    assert node.state() == 'unconfigured'
    assert node.change(Transition.TRANSITION_DEACTIVATE) == 'unconfigured'
    for _ in range(2):
        assert node.change(Transition.TRANSITION_CONFIGURE) == 'inactive'
        assert node.change(Transition.TRANSITION_ACTIVATE) == 'active'
        assert node.change(Transition.TRANSITION_DEACTIVATE) == 'inactive'
        assert node.change(Transition.TRANSITION_CLEANUP) == 'unconfigured'
    node.change(Transition.TRANSITION_CONFIGURE)
    node.change(Transition.TRANSITION_ACTIVATE)
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVE_SHUTDOWN))
    node._change.call_async(request)
    assert node.process.wait(PATIENCE) == 0


def test_node_with_a_bad_scene_stays_unconfigured_says_why_and_lives(
    managers: Any, folder: Path
) -> None:
    scene = folder / 'bad.yaml'
    scene.write_text('tissue: {mesh: nowhere.msh}\n')
    node = managers('tissue_sim', scene)
    assert node.change(Transition.TRANSITION_CONFIGURE) == 'unconfigured'
    assert node.process.poll() is None
    assert 'nowhere.msh' in node.close()


def test_a_bridge_that_rests_leaves_no_force_and_comes_back_without_one(managers: Any) -> None:
    nodes = {name: managers(name) for name in ('tissue_sim', 'emulated_arm', 'haptic_bridge')}
    bridge = nodes['haptic_bridge']
    for node in nodes.values():
        node.change(Transition.TRANSITION_CONFIGURE)
        node.change(Transition.TRANSITION_ACTIVATE)
    forces = polled(bridge.node, WrenchStamped, 'arm/servo_cf', NEWEST_BEST_EFFORT)
    wait_for(lambda: take_raw(forces), 'commands')
    bridge.change(Transition.TRANSITION_DEACTIVATE)
    last = None
    while (raw := take_raw(forces)) is not None:
        last = raw
    assert last is None or not any(WrenchStampedCodec().decode(last).values)
    bridge.change(Transition.TRANSITION_ACTIVATE)
    raw = wait_for(lambda: take_raw(forces), 'commands of a bridge that works again')
    assert not any(WrenchStampedCodec().decode(raw).values)


ENDS = """
import os, signal, sys
from cutting_trainer.node_common.lifecycle import ManagedNode, run

def sockets():
    rows = open('/proc/self/net/udp').read().splitlines()[1:]
    udp = {f'socket:[{row.split()[9]}]' for row in rows}
    links = [f'/proc/self/fd/{number}' for number in os.listdir('/proc/self/fd')]
    return sum(os.readlink(at) in udp for at in links if os.path.islink(at))

class Lives(ManagedNode):
    def configure(self):
        print(f'{sockets()} sockets at the start')
        if 'fails' in sys.argv:
            raise ValueError('it is to fail')

    def work(self, stop):
        print(f'{sockets()} sockets at work')
        os.kill(os.getpid(), signal.SIGINT)
        stop.wait()

try:
    run(lambda: Lives('lives'))
finally:
    print(f'{sockets()} sockets at the end')
"""


@pytest.mark.parametrize('end', ['interrupted', 'fails'])
def test_no_thread_of_the_middleware_outlives_a_node(end: str) -> None:
    """One that does reads what the end of the process destroys: a node died of SIGSEGV so."""
    command = [sys.executable, '-c', ENDS, end]
    done = subprocess.run(
        command, cwd=ROOT, env=node_environment(free_domain()), capture_output=True, text=True
    )
    counts = [int(line.split()[0]) for line in done.stdout.splitlines() if 'sockets' in line]
    assert done.returncode == (2 if end == 'fails' else 0), done
    assert counts[0] > 0 and counts[-1] == 0, done


HANGS = """
import ctypes, os, signal, sys
from cutting_trainer.node_common.lifecycle import ManagedNode, run

class Hangs(ManagedNode):
    def configure(self):
        if 'fails' in sys.argv:
            raise ValueError('it is to fail')

    def work(self, stop):
        os.kill(os.getpid(), signal.SIGINT)
        stop.wait()

    def release(self):
        print('work is done', flush=True)

    def destroy_node(self):
        ctypes.PyDLL(None).sleep(60)  # as the middleware does: no other thread of Python runs

run(lambda: Hangs('hangs'))
"""


@pytest.mark.parametrize(
    ('end', 'said'), [('interrupted', 'work is done'), ('fails', 'error: it is to fail')]
)
def test_a_node_ends_and_says_all_though_its_middleware_hangs(end: str, said: str) -> None:
    command = [sys.executable, '-c', HANGS, end]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=node_environment(free_domain()),
        capture_output=True,
        text=True,
        timeout=30,
    )
    assert done.returncode == -signal.SIGALRM and done.returncode in EXPECTED_STATUSES, done
    assert said in done.stdout + done.stderr, done
