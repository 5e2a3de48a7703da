"""Claims about who has to be at the other end of a device's topics before a force is given."""

import time
from collections.abc import Iterator
from contextlib import suppress

import pytest
import rclpy
from geometry_msgs.msg import Wrench, WrenchStamped
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from std_msgs.msg import String

from cutting_trainer.haptic_bridge.devices.probe_graph import Wiring
from cutting_trainer.node_common.operating_state import crtk_types
from cutting_trainer.node_common.qos import EVENTS, LATCHED, NEWEST_BEST_EFFORT, STREAM
from cutting_trainer.session.domain import reserved_domain

pytestmark = pytest.mark.long

TOPIC = '/left/arm/servo_cf'


class Graph:
    """Nodes of one domain, each of a participant of its own; the bridge's is in `left`."""

    def __init__(self, domain: int) -> None:
        self._domain = domain
        self._nodes: list[Node] = []
        bridge = self.node('haptic_bridge', '/left')
        force = bridge.create_publisher(WrenchStamped, 'arm/servo_cf', STREAM)
        types = {'arm/operating_state': crtk_types().operating_state}
        self.wiring = Wiring(bridge, force, types)
        self._bridge = bridge

    def node(self, name: str, namespace: str = '/') -> Node:
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=self._domain)
        made = Node(name, namespace=namespace, context=context)
        self._nodes.append(made)
        return made

    def hear(self, name: str, namespace: str = '/', topic: str = TOPIC, **how: object) -> Node:
        node = self.node(name, namespace)
        before = self._bridge.count_subscribers(topic)
        kind, qos = how.get('kind', WrenchStamped), how.get('qos', NEWEST_BEST_EFFORT)
        node.create_subscription(kind, topic, lambda _: None, qos)
        self.settle(lambda: self._bridge.count_subscribers(topic) > before)
        return node

    def settle(self, seen: object) -> None:
        deadline = time.monotonic() + 60.0
        while not seen():
            assert time.monotonic() < deadline, 'the graph does not see it'
            time.sleep(0.02)
        time.sleep(0.1)

    def close(self) -> None:
        for node in self._nodes:
            with suppress(InvalidHandle):
                node.destroy_node()
            rclpy.shutdown(context=node.context)


@pytest.fixture
def graph() -> Iterator[Graph]:
    with reserved_domain('free') as domain:
        made = Graph(domain)
    yield made
    made.close()


def test_nobody_or_only_our_own_listeners_is_a_cause_that_names_the_topic(graph):
    assert f'nobody takes the force on {TOPIC}' in graph.wiring.cause()
    graph.hear('recorder')  # of both sides, above the bridge
    graph.hear('viewer', '/left')
    graph.hear('_ros2cli_4711')
    assert f'nobody takes the force on {TOPIC}' in graph.wiring.cause()
    assert 'start the driver' in graph.wiring.cause()


def test_a_device_counts_whatever_it_is_called_until_it_goes_away(graph):
    device = graph.hear('viewer', '/MTML')  # not ours: it is in a namespace of its own
    assert graph.wiring.cause() == ''
    graph.hear('omni_adapter', qos=STREAM)
    assert graph.wiring.cause() == ''
    for node in (device, graph._nodes[-1]):
        node.destroy_node()
    graph.settle(lambda: not graph._bridge.count_subscribers(TOPIC))
    assert 'nobody takes the force' in graph.wiring.cause()


def test_who_takes_the_force_elsewhere_is_named_with_what_to_set(graph):
    graph.hear('dvrk', topic='/MTML/body/servo_cf')
    graph.hear('recorder', topic='/PSM1/servo_cf')
    cause = graph.wiring.cause()
    assert 'there is /MTML/body/servo_cf' in cause and 'PSM1' not in cause
    assert 'device.force_topic' in cause


def test_a_subscriber_that_can_never_match_does_not_take_the_force(graph):
    graph.hear('old_driver', kind=Wrench)
    assert '/old_driver takes' in graph.wiring.cause()
    assert 'geometry_msgs/msg/Wrench,' in graph.wiring.cause()
    graph.hear('shy_driver', qos=LATCHED)
    assert '/shy_driver asks' in graph.wiring.cause()
    graph.hear('driver')
    assert graph.wiring.cause() == ''


def test_a_state_of_another_type_is_a_cause_with_what_to_install(graph):
    graph.hear('driver')
    driver = graph.node('dvrk', '/console')
    driver.create_publisher(String, '/left/arm/operating_state', EVENTS)
    # The name of a node is known some time after its publisher.
    publishers = graph._bridge.get_publishers_info_by_topic
    graph.settle(lambda: any(p.node_name == 'dvrk' for p in publishers('arm/operating_state')))
    cause = graph.wiring.cause()
    assert '/left/arm/operating_state comes from /console/dvrk as std_msgs/msg/String' in cause
    assert './trainer overlay' in cause
