"""A second node publishes what moves the hand: it is named, and there is no force, at any pace."""

import time
from typing import Any

import pytest
import rclpy
from bridge_world import Record, World, session
from geometry_msgs.msg import PoseStamped
from live import free_domain
from rclpy.node import Node

from cutting_trainer.haptic_bridge.force_kernels import INSIDE
from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.cdr_codec import ForceSampleCodec

pytestmark = pytest.mark.live

SCENE = """
tool: {radius: 0.004, coupling_stiffness: 200}
device: {profile: dvrk_mtm}
haptics: {soft_start: 0.0, device_timeout: 0.5, stale_after: 1.0}
"""


def forged(world: World) -> bytes:
    """The tissue holds the blade, with 50 N, in free air."""
    values = (world.revision + 10**6, world.revision, 1, 0, 0, 0, INSIDE, 0.0, 0.0, 0.05)
    values += (0.0, 0.0, 50.0, *(0.0,) * 9, 100.0, 0.0, 0.0)
    return ForceSampleCodec('tissue').encode(time.time_ns(), values)


def play(world: World, record: Record) -> None:
    world.wait_for('ENABLED', 60.0)
    world.move(0.05, 0.2)
    for name, kind, topic in (
        ('slow', world.force.msg_type, ros.FORCE),
        ('silent', PoseStamped, 'arm/measured_cp'),
    ):
        thief = Node(f'{name}_thief')
        record.marks[name] = time.time_ns()
        publisher: Any = thief.create_publisher(kind, topic, qos.STREAM)
        world.wait_for('FAULT', 5.0)
        record.marks[f'{name} found'] = time.time_ns()
        if name == 'slow':
            for _ in range(2):
                publisher.publish(forged(world))
                time.sleep(1.1)
        world.wait_until(lambda name=name: name in record.statuses[-1].get('stranger', ''))
        world.command.publish(world.message(string='enable'))
        time.sleep(0.2)
        record.marks[f'{name} refused'] = record.states[-1][1] == 'FAULT'
        thief.destroy_node()
        world.wait_until(lambda: record.statuses[-1].get('stranger') == '')
        world.command.publish(world.message(string='enable'))
        world.wait_for('ENABLED', 5.0)
        record.marks[f'{name} over'] = time.time_ns()


@pytest.fixture(scope='module')
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    scene = tmp_path_factory.mktemp('impostors') / 'flat.yaml'
    scene.write_text(SCENE)
    assert not rclpy.ok()
    return session(scene, free_domain(), play)


@pytest.mark.parametrize('name', ['slow', 'silent'])
def test_an_impostor_is_named_and_there_is_no_force_until_it_has_gone(record, name):
    assert record.marks[f'{name} refused']
    during = [
        w.values[:3]
        for w in record.wrenches
        if record.marks[name] <= w.stamp_ns < record.marks[f'{name} over']
    ]
    assert len(during) > 200
    assert not any(map(any, during))
    assert any(f'/{name}_thief' in said for said in record.said)
