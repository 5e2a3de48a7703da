"""Exchange messages between two processes through DDS, as nodes do, and time them.

Run as `python -m cutting_trainer.cli.dds_loopback`; the domain is `ROS_DOMAIN_ID`. Two processes,
because within one the middleware hands messages over without its transport.
"""

import os
import subprocess
import sys
import time
from typing import Any

DISCOVERY = 10.0
"""[s] in which the two must have found each other."""
ANSWER = 2.0
TRIPS = 20


def echo(name: str) -> None:
    """Send every message back, until standard input ends; the other process's side.

    Args:
        name: that the topics begin with.
    """
    import threading

    node, publisher, subscription = _ends(f'{name}_pong', f'{name}_ping')
    over = threading.Event()

    def wait_for_end() -> None:
        sys.stdin.read()
        over.set()

    threading.Thread(target=wait_for_end, daemon=True).start()
    while not over.wait(2e-4):
        message = _take(subscription)
        if message is not None:
            publisher.publish(message)
    node.destroy_node()


def loopback() -> str:
    """Send a few messages to another process and back; return the times as a sentence.

    Raises:
        RuntimeError: they do not find each other, or a message does not come.
    """
    name = f'trainer_doctor_{os.getpid()}'
    other = [sys.executable, '-m', 'cutting_trainer.cli.dds_loopback', name]
    with subprocess.Popen(other, stdin=subprocess.PIPE) as process:
        try:
            return _measure(name)
        finally:
            assert process.stdin
            process.stdin.close()


def _measure(name: str) -> str:
    node, publisher, subscription = _ends(f'{name}_ping', f'{name}_pong')
    start = time.monotonic()
    while not (publisher.get_subscription_count() and node.count_publishers(f'{name}_pong')):
        if time.monotonic() - start > DISCOVERY:
            raise RuntimeError(f'two processes did not find each other in {DISCOVERY:g} s')
        time.sleep(0.01)
    trips = []
    for number in range(TRIPS):
        sent = time.monotonic()
        publisher.publish(subscription.msg_type(data=str(number)))
        while (message := _take(subscription)) is None or message.data != str(number):
            if time.monotonic() - sent > ANSWER:
                raise RuntimeError(f'message {number} of {TRIPS} did not come in {ANSWER:g} s')
            time.sleep(2e-4)
        trips.append(time.monotonic() - sent)
    node.destroy_node()
    middle = sorted(trips)[TRIPS // 2] * 1e3
    middleware = os.environ.get('RMW_IMPLEMENTATION', 'the default middleware')
    return f'{TRIPS} messages to another process and back by {middleware}, median {middle:.1f} ms'


def _ends(outgoing: str, incoming: str) -> tuple[Any, Any, Any]:
    """Return a node with a publisher and a polled subscription, in the transport of the nodes."""
    from cutting_trainer.session.node_commands import discovery

    os.environ.update(discovery(os.environ))

    import rclpy
    from std_msgs.msg import String

    from cutting_trainer.node_common.qos import EVENTS
    from cutting_trainer.node_common.ros import polled

    rclpy.init()
    node = rclpy.create_node(outgoing)
    return (
        node,
        node.create_publisher(String, outgoing, EVENTS),
        polled(node, String, incoming, EVENTS),
    )


def _take(subscription: Any) -> Any:
    from cutting_trainer.node_common.ros import take

    return take(subscription)


if __name__ == '__main__':
    if sys.argv[1:]:
        echo(sys.argv[1])
    else:
        try:
            print(loopback())
        except Exception as error:
            print(f'{type(error).__name__}: {error}', file=sys.stderr)
            sys.exit(1)
