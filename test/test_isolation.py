"""What a session says stays on its machine, in its domain and partition, unless asked not to."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from shutil import which

import pytest
from live import ROOT, free_domain, node_words, running, two_presses, write_scene

from bench.graph.impaired_link import TwoHosts, missing_rights
from cutting_trainer.session.network import Network, network_environment
from cutting_trainer.session.node_commands import MODULES, node_environment

pytest.importorskip('rclpy')
pytestmark = [
    pytest.mark.live,
    pytest.mark.skipif(bool(missing_rights()), reason=missing_rights()),
]

SECONDS = 2.5
STRANGER = """
import json, sys, time
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from cutting_trainer.node_common.operating_state import crtk_types
from cutting_trainer.node_common.qos import EVENTS, LATCHED, NEWEST_BEST_EFFORT
from cutting_trainer.node_common.ros import polled, take, take_raw
rclpy.init()
node, types = Node('stranger'), crtk_types()
poses = polled(node, PoseStamped, 'arm/measured_cp', NEWEST_BEST_EFFORT)
states = polled(node, types.operating_state, 'arm/operating_state', LATCHED)
command = node.create_publisher(types.command, 'arm/state_command', EVENTS)
heard, state, end = 0, '', time.monotonic() + float(sys.argv[1])
while time.monotonic() < end:
    heard += take_raw(poses) is not None
    while (said := take(states)) is not None:
        state = said.state
    if sys.argv[2] == 'meddle':
        command.publish(types.command(string='disable'))
    time.sleep(0.02)
print(json.dumps({'heard': heard, 'state': state}))
"""
"""Listens to an arm and, if it meddles, tells it to be DISABLED."""


@pytest.fixture(scope='module')
def hosts() -> Iterator[TwoHosts]:
    with TwoHosts() as made:
        yield made


def found(
    hosts: TwoHosts,
    tmp_path: Path,
    arms: dict[str, str],
    strangers: dict[str, str],
    host: int,
    then: str = 'meddle',
) -> dict[str, object]:
    """What a stranger on a host gets of an arm on host 0."""
    scene = write_scene(tmp_path, two_presses(), 7.0, 100.0)
    arm = hosts.on(0, node_words(MODULES['emulated_arm'], '-p', f'scene:={scene}'))
    with running(arm, arms, 'ready: emulated_arm'):
        listener = [sys.executable, '-c', STRANGER, str(SECONDS)]
        done = subprocess.run(
            hosts.on(host, [*listener, then]), cwd=ROOT, env=strangers, stdout=-1, check=True
        )
        if then == 'meddle':  # and what the arm says to its own machine after that
            own = subprocess.run(
                hosts.on(0, [*listener, 'listen']), cwd=ROOT, env=arms, stdout=-1, check=True
            )
            return {'heard': json.loads(done.stdout)['heard'], 'own': json.loads(own.stdout)}
        return dict(json.loads(done.stdout))


def on_the_network(domain: int, hosts: TwoHosts, other: int) -> dict[str, str]:
    network = Network(peers=(hosts.addresses[other],))
    return node_environment(domain) | network.variables(os.environ)


@pytest.mark.thorough
def test_on_the_network_an_arm_is_heard_and_obeys(hosts: TwoHosts, tmp_path: Path) -> None:
    domain = free_domain()
    arms, strangers = (on_the_network(domain, hosts, other) for other in (1, 0))
    got = found(hosts, tmp_path, arms, strangers, 1)
    assert got['heard'] > 50
    assert got['own']['state'] == 'DISABLED'


def test_by_default_another_host_hears_nothing_and_is_not_heard(
    hosts: TwoHosts, tmp_path: Path
) -> None:
    domain = free_domain()
    got = found(hosts, tmp_path, node_environment(domain), on_the_network(domain, hosts, 0), 1)
    assert got['heard'] == 0
    assert got['own']['heard'] > 50
    assert got['own']['state'] == 'ENABLED'


@pytest.mark.thorough
def test_another_domain_hears_nothing_and_is_not_heard(hosts: TwoHosts, tmp_path: Path) -> None:
    domain = free_domain()
    got = found(hosts, tmp_path, node_environment(domain), node_environment(domain + 1), 0)
    assert got['heard'] == 0
    assert got['own']['state'] == 'ENABLED'


@pytest.mark.thorough
@pytest.mark.parametrize(('theirs', 'same'), [('lab_b', False), ('lab_a', True), ('', False)])
def test_another_partition_hears_nothing_and_is_not_heard(
    hosts: TwoHosts, tmp_path: Path, theirs: str, same: bool
) -> None:
    domain = free_domain()
    with (
        network_environment(domain, Network(partition='lab_a')) as arms,
        network_environment(domain, Network(partition=theirs)) as strangers,
    ):
        got = found(hosts, tmp_path, arms, strangers, 0)
    assert (got['heard'] > 50) is same
    assert got['own']['state'] == ('DISABLED' if same else 'ENABLED')


@pytest.mark.thorough
@pytest.mark.skipif(not which('fast-discovery-server'), reason='no fast-discovery-server')
def test_hosts_find_each_other_by_a_discovery_server(hosts: TwoHosts, tmp_path: Path) -> None:
    address = hosts.addresses[1]
    server = subprocess.Popen(
        hosts.on(1, ['fast-discovery-server', '-i', '0', '-l', address, '-p', '11811']),
        stdout=subprocess.DEVNULL,
    )
    try:
        domain, network = free_domain(), Network(server=address)
        both = node_environment(domain) | network.variables(os.environ)
        assert found(hosts, tmp_path, both, both, 1)['heard'] > 50
    finally:
        server.kill()
        server.wait()
