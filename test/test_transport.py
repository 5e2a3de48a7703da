"""The transport between the nodes: on this machine only, and no process can hold up another's."""

import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from live import PATIENCE, ROOT, free_domain, running

from cutting_trainer.session.domain import RANGE
from cutting_trainer.session.network import Network, network_environment
from cutting_trainer.session.node_commands import PROFILES, discovery, node_environment

pytestmark = pytest.mark.long

DDS = '{http://www.eprosima.com}'
FREEZES, SENT = 40, 20
"""A process that is stopped, or killed, at a random moment may hold a lock. What another sends
meanwhile."""
TALK = """
import os, sys, time
import rclpy
from std_msgs.msg import Header
from cutting_trainer.node_common.qos import STREAM

role = sys.argv[1]
rclpy.init()
node = rclpy.create_node(f'{role}_{os.getpid()}')
if role == 'reader':
    heard = [node.create_subscription(Header, n, lambda _: None, STREAM) for n in ('a', 'b')]
    print('ready', flush=True)
    rclpy.spin(node)
publisher = node.create_publisher(Header, 'a' if role == 'steady' else 'b', STREAM)
while not publisher.get_subscription_count():
    time.sleep(0.01)
print('ready', flush=True)
while role == 'flood':
    publisher.publish(Header(frame_id='x' * 100))
while True:
    time.sleep(0.001)
    publisher.publish(Header(frame_id='x' * 100))
    print('sent', flush=True)
"""


def process(role: str, environment: dict[str, str]) -> Any:
    """A process that publishes or listens, ready; killed at the end."""
    return running([sys.executable, '-c', TALK, role], environment, 'ready')


def sends(steady: 'subprocess.Popen[str]', seconds: float) -> int:
    """Count the messages that a process has sent since this was last asked, up to `SENT`.

    Args:
        steady: the process.
        seconds: to wait for each.
    """
    assert steady.stdout is not None
    pipe, count = steady.stdout.fileno(), 0
    while count < SENT and select.select([pipe], [], [], seconds)[0]:
        count += os.read(pipe, 5).count(b'\n')
    return count


def sockets(pid: int) -> set[str]:
    """Local addresses, as the kernel writes them, of the UDP sockets of a process."""
    own = {str(fd.readlink()) for fd in Path(f'/proc/{pid}/fd').iterdir()}
    rows = [r.split() for r in Path('/proc/net/udp').read_text().splitlines()[1:]]
    return {row[1].partition(':')[0] for row in rows if f'socket:[{row[9]}]' in own}


@pytest.fixture
def environment() -> dict[str, str]:
    return node_environment(free_domain())


def test_writer_is_not_held_up_by_another_that_is_frozen_while_it_writes(
    environment: dict[str, str],
) -> None:
    with (
        process('reader', environment),
        process('steady', environment) as steady,
        process('flood', environment) as flood,
    ):
        for _ in range(FREEZES):
            flood.send_signal(signal.SIGSTOP)
            while sends(steady, 0.0) == SENT:
                pass  # of before
            assert sends(steady, PATIENCE) == SENT
            flood.send_signal(signal.SIGCONT)
            time.sleep(0.01)


def wakes(pid: int) -> int:
    """How often the thread for the timers of the middleware has waited in a process."""
    (thread,) = (
        task
        for task in Path(f'/proc/{pid}/task').iterdir()
        if (task / 'comm').read_text().startswith('dds.ev')
    )
    status = (thread / 'status').read_text()
    return int(status.partition('\nvoluntary_ctxt_switches:')[2].split()[0])


def test_samples_start_no_timer_each(environment: dict[str, str]) -> None:
    with process('reader', environment), process('steady', environment) as steady:
        time.sleep(2.0)  # participants find each other
        while sends(steady, 0.0) == SENT:
            pass  # of before
        before, began = wakes(steady.pid), time.monotonic()
        for _ in range(50):
            assert sends(steady, PATIENCE) >= SENT
        periods = (time.monotonic() - began) / 0.01
        assert wakes(steady.pid) - before < 20 + 4 * periods


def test_nodes_share_no_memory_and_listen_on_this_machine_only(environment: dict[str, str]) -> None:
    with process('reader', environment) as reader:
        assert '/dev/shm/fastrtps' not in Path(f'/proc/{reader.pid}/maps').read_text()
        assert sockets(reader.pid) == {'0100007F'}


def test_node_with_the_range_of_everybody_else_is_heard(environment: dict[str, str]) -> None:
    foreign = {k: v for k, v in environment.items() if k != PROFILES} | {RANGE: 'LOCALHOST'}
    with process('reader', environment), process('steady', foreign) as steady:
        assert steady.poll() is None  # it has found the reader
    with process('reader', foreign), process('steady', environment) as steady:
        assert steady.poll() is None


@pytest.mark.parametrize(
    ('shell', 'expected'),
    [
        ({}, ('SYSTEM_DEFAULT', 'localhost')),
        ({RANGE: 'LOCALHOST'}, ('SYSTEM_DEFAULT', 'localhost')),
        ({RANGE: 'SUBNET'}, ('SUBNET', 'network')),
        ({PROFILES: '/own.xml'}, ('LOCALHOST', '/own.xml')),
        ({RANGE: 'SUBNET', PROFILES: '/own.xml'}, ('SUBNET', '/own.xml')),
    ],
)
def test_shell_decides_how_far_the_nodes_reach(
    shell: dict[str, str], expected: tuple[str, str]
) -> None:
    asked, profile = expected
    path = profile if profile.startswith('/') else str(ROOT / f'config/dds/{profile}.xml')
    assert discovery(shell) == {RANGE: asked, PROFILES: path}
    assert discovery(shell | discovery(shell)) == discovery(shell)


def test_a_partition_adds_to_what_the_profile_says_of_writers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ('ROS_STATIC_PEERS', RANGE):
        monkeypatch.delenv(name, raising=False)
    with network_environment(0, Network(open=True, partition='lab_a')) as environment:
        profiles = ElementTree.parse(environment[PROFILES]).getroot()[0]
    for kind in ('data_writer', 'data_reader'):
        (default,) = profiles.findall(f'{DDS}{kind}[@is_default_profile="true"]')
        assert default.findtext(f'.//{DDS}partition//{DDS}name') == 'lab_a'
        assert (default.find(f'{DDS}times') is not None) == (kind == 'data_writer')


def test_peers_are_looked_for_from_within_a_program_of_the_users_own_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in (RANGE, PROFILES):
        monkeypatch.delenv(name, raising=False)
    within = discovery({})  # what `trainer run` gives the program
    assert discovery(within) == within
    assert Path(within[PROFILES]).stem == 'localhost'
    asked = Network(peers=('192.168.1.20',)).variables(within)
    assert (asked[RANGE], Path(asked[PROFILES]).stem) == ('SUBNET', 'network')
