"""Who may publish what moves the hand: judged by the graph's list, whatever they send."""

import sys
import time
from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from live import running
from rclpy.node import Node

from cutting_trainer.node_common.publishers import (
    LEASE_TIMEOUT_S,
    NAME_TIMEOUT_S,
    Publisher,
    PublisherList,
    PublisherMonitor,
    full_name,
)
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.node_commands import node_environment

ARM, AGAIN, THIEF = Publisher(b'a', '/arm'), Publisher(b'b', '/arm'), Publisher(b'c', '/thief')


def test_a_second_publisher_is_named_at_once_and_forgotten_when_it_has_gone():
    topic = PublisherList('/p')
    assert topic.judge([ARM], 0.0) == ''
    said = topic.judge([THIEF, ARM], 0.02)
    assert 'more than one publisher' in said and 'beside /arm there is /thief' in said
    assert topic.judge([ARM], 0.04) == ''


def test_one_that_takes_the_place_of_one_that_died_is_no_second_one():
    topic = PublisherList('/p')
    topic.judge([ARM], 0.0)
    assert topic.judge([ARM, AGAIN], 1.0) == ''
    assert topic.judge([ARM, AGAIN], 1.0 + 0.99 * LEASE_TIMEOUT_S) == ''
    assert topic.judge([AGAIN], 1.1 + LEASE_TIMEOUT_S) == ''


def test_two_of_the_same_name_that_both_stay_are_two():
    topic = PublisherList('/p')
    topic.judge([ARM], 0.0)
    topic.judge([ARM, AGAIN], 1.0)
    assert '/arm twice' in topic.judge([ARM, AGAIN], 1.1 + LEASE_TIMEOUT_S)


@pytest.mark.parametrize('there', [[THIEF], [ARM, THIEF]])
def test_of_whom_the_scene_does_not_accept_one_alone_is_named_too(there):
    said = PublisherList('/p', ['/arm']).judge(there, 0.0)
    assert '/p is published by /thief: accepted is /arm' in said
    assert PublisherList('/p', ['/arm', '/thief']).judge(there, 0.0) == ''


def test_a_node_that_keeps_its_name_to_itself_is_a_stranger_after_a_second():
    topic = PublisherList('/p')
    hidden = Publisher(b'd', '')
    topic.judge([ARM], 0.0)
    assert topic.judge([ARM, hidden], 1.0) == ''
    assert 'a node without a name' in topic.judge([ARM, hidden], 1.1 + NAME_TIMEOUT_S)


PUBLISHER = """
import sys, time, rclpy
from std_msgs.msg import Empty
rclpy.init()
node = rclpy.create_node('tissue_sim')
end = node.create_publisher(Empty, 'watched', 10)
print('ready', flush=True)
while True:
    end.publish(Empty())
    time.sleep(0.03)
"""


def publishing(domain: int) -> Any:
    return running([sys.executable, '-c', PUBLISHER], node_environment(domain), 'ready')


@pytest.mark.live
def test_a_node_that_is_killed_and_started_again_is_never_taken_for_two(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # How long the graph takes to learn a name is the machine's matter, and another claim's.
    monkeypatch.setattr('cutting_trainer.node_common.publishers.NAME_TIMEOUT_S', 60.0)
    with reserved_domain('free') as domain:
        for key, value in node_environment(domain).items():
            monkeypatch.setenv(key, value)
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=domain)
        node = Node('watcher', context=context)
        watch, most, said = PublisherMonitor(node, ['watched'], ['/tissue_sim']), 0, set()

        def look(until: Callable[[], bool], seconds: float) -> None:
            nonlocal most
            end = time.monotonic() + seconds
            while not until() and time.monotonic() < end:
                said.add(watch.look(time.monotonic()))
                most = max(most, node.count_publishers('/watched'))
                time.sleep(0.02)

        def named(topic: str) -> int:
            """Publishers whose node the graph knows: one that dies before has no name."""
            return sum(bool(full_name(i)) for i in node.get_publishers_info_by_topic(topic))

        try:
            with publishing(domain):
                look(lambda: named('/watched') == 1, 30.0)
            with publishing(domain):
                look(lambda: most == 2, 30.0)
                look(lambda: node.count_publishers('/watched') == named('/watched') == 1, 30.0)
                assert node.count_publishers('/watched') == 1
        finally:
            node.destroy_node()
            rclpy.shutdown(context=context)
    assert most == 2  # the dead one was still in the graph
    assert said == {''}
