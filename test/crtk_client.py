"""A CRTK client that knows nothing of this project, for test_crtk_client.py.

It keeps to the public `crtk_python_client` 1.4.0, which no package index has and which needs PyKDL;
checked against that source line by line, in what the other side can see:

- `ral_ros2.ral.subscriber` and `publisher`: reliable, keep last 10; subscriptions are volatile,
  that of `operating_state` too; only the publisher of `state_command` is latched
  (`utils.add_operating_state`);
- `ral._check_connections`: 5 s for every publisher to have a subscriber and the other way round;
- `utils.__operating_state_cb`: a message whose stamp is not newer than the last changes nothing,
  but wakes whoever waits;
- `utils.__enable`, `__disable`: in the state already, the command is sent and True returned;
  else the event is cleared, the command sent (which clears it once more), and
  `__wait_for_operating_state` waits for the messages that follow until one has the state;
- `utils.__home`, `__unhome`: the same with `__wait_for_homed`, which clears the event after the
  command was sent, and also waits for `is_busy` to be False;
- `utils.__set_timestamp`, `__servo_cf`, `__servo_cp`: each message has the stamp of its sending and
  an empty frame_id;
- `utils.__measured_cf` and the like: a TimeoutError where the newest message is older than 1 s;
- its single-threaded executor in a daemon thread (`ral.spin`). It has no use for the query service.

It imports ROS alone. What it saw goes to standard output as JSON.

Arguments: NAMES_OF_TYPES_PACKAGE arm|device NAMESPACE [BRIDGE].
"""

import importlib
import json
import sys
import threading
import time
from contextlib import suppress

import rclpy
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile
from rclpy.time import Time

CONNECTION, FRESH = 5.0, 1.0


class Client:
    """One node with what `crtk.ral` does; devices are made from it."""

    def __init__(self, package):
        rclpy.init()
        self.node = rclpy.create_node('crtk_client')
        self.messages = importlib.import_module(f'{package}.msg')
        self.services = importlib.import_module(f'{package}.srv')
        self.pairs = []
        self.thread = threading.Thread(target=self._spin, daemon=True)

    def _spin(self):
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        with suppress(ExternalShutdownException):
            executor.spin()

    def close(self):
        rclpy.shutdown()
        self.thread.join()

    def subscribe(self, kind, topic, hear):
        qos = QoSProfile(depth=10, history=HistoryPolicy.KEEP_LAST)
        handle = self.node.create_subscription(kind, topic, hear, qos)
        self.pairs.append((topic, lambda: self.node.count_publishers(handle.topic_name)))

    def publisher(self, kind, topic, latch=False):
        qos = QoSProfile(depth=10, history=HistoryPolicy.KEEP_LAST)
        if latch:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        handle = self.node.create_publisher(kind, topic, qos)
        self.pairs.append((topic, handle.get_subscription_count))
        return handle

    def check_connections(self):
        deadline = time.monotonic() + CONNECTION
        while missing := [topic for topic, count in self.pairs if not count()]:
            if time.monotonic() > deadline:
                sys.exit(f'nobody is at the other end of {", ".join(missing)}')
            time.sleep(0.01)

    def stamped(self, message):
        message.header.stamp = self.node.get_clock().now().to_msg()
        return message

    def query(self, namespace):
        """The state by the service of CRTK, which the Python client does not use."""
        kind = self.services.TriggerOperatingState
        service = self.node.create_client(kind, f'{namespace}/operating_state')
        if not service.wait_for_service(CONNECTION):
            sys.exit(f'there is no service {namespace}/operating_state')
        answer = service.call(kind.Request()).operating_state
        return [answer.state, answer.is_homed, answer.is_busy]


class Operated:
    """What `crtk.utils.add_operating_state` makes of a namespace."""

    def __init__(self, client, namespace):
        self.client = client
        self.newest = client.messages.OperatingState()
        self.announced = []
        self.event = threading.Event()
        client.subscribe(client.messages.OperatingState, f'{namespace}/operating_state', self._hear)
        self.sender = client.publisher(
            client.messages.StringStamped, f'{namespace}/state_command', latch=True
        )

    def _hear(self, message):
        self.announced.append(message.state)
        if Time.from_msg(message.header.stamp) > Time.from_msg(self.newest.header.stamp):
            self.newest = message
        self.event.set()

    def command(self, word):
        self.event.clear()
        self.sender.publish(self.client.stamped(self.client.messages.StringStamped(string=word)))

    def _wait(self, reached, timeout, clear):
        deadline = time.monotonic() + timeout
        while (left := deadline - time.monotonic()) >= 0:
            if clear:
                self.event.clear()
            if not self.event.wait(left):
                return False
            if reached():
                return True
            self.event.clear()
        return False

    def _go(self, word, reached, timeout, clear):
        if reached():
            self.command(word)
            return True
        self.event.clear()
        self.command(word)
        return self._wait(reached, timeout, clear)

    def to_state(self, word, state, timeout=3.0):
        return self._go(word, lambda: self.newest.state == state, timeout, False)

    def to_homed(self, word, homed, timeout=3.0):
        def there():
            return self.newest.is_homed == homed

        if there():
            return self._go(word, there, timeout, True)
        self.event.clear()
        self.command(word)
        return self._wait(lambda: there() and not self.newest.is_busy, timeout, True)

    def after(self, word, seconds=0.2):
        """The state after a command that is only sent."""
        self.command(word)
        time.sleep(seconds)
        return self.newest.state


def asked(operated):
    """A client that has just joined, and what it is told when it enables and homes."""
    report = {'before a word': operated.newest.state}
    for name, ask in (
        ('enable', lambda: operated.to_state('enable', 'ENABLED')),
        ('home', lambda: operated.to_homed('home', True)),
    ):
        began = time.monotonic()
        report[name] = ask(), time.monotonic() - began
    report['then'] = [operated.newest.state, operated.newest.is_homed]
    return report


def around(operated):
    """Whether every way through the states ends where it should, by the client's own waiting."""
    return [
        operated.to_state('disable', 'DISABLED'),
        operated.to_state('disable', 'DISABLED'),
        operated.to_homed('unhome', False),
        operated.to_homed('home', True),
        operated.to_state('enable', 'ENABLED'),
    ]


class Newest:
    """The newest message of a topic, or a TimeoutError where that is too old."""

    def __init__(self, client, kind, topic):
        self.messages, self.heard = [], -FRESH
        client.subscribe(kind, topic, self._hear)

    def _hear(self, message):
        self.messages.append(message)
        self.heard = time.monotonic()

    def __call__(self):
        if time.monotonic() - self.heard > FRESH:
            raise TimeoutError('no data received')
        return self.messages[-1]


def play_with_arm(client, namespace):
    """A client of an arm: enables, reads, commands a force, goes through the states."""
    arm = Operated(client, namespace)
    read = {
        name: Newest(client, kind, f'{namespace}/{name}')
        for name, kind in (
            ('measured_cp', PoseStamped),
            ('measured_cv', TwistStamped),
            ('measured_cf', WrenchStamped),
        )
    }
    servo_cf = client.publisher(WrenchStamped, f'{namespace}/servo_cf')
    hand = client.publisher(PoseStamped, f'{namespace}/hand/servo_cp')
    client.thread.start()
    client.check_connections()

    def servo(newtons, seconds):
        """The largest force felt meanwhile: a machine that is held up may let go in between."""
        felt = read['measured_cf'].messages
        start = len(felt)
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            message = client.stamped(WrenchStamped())
            message.wrench.force.z = newtons
            servo_cf.publish(message)
            time.sleep(0.002)
        return max(message.wrench.force.z for message in felt[start:])

    time.sleep(0.5)
    report = {'joined': asked(arm), 'query': client.query(namespace)}
    report['with command'] = servo(0.5, 0.5)
    time.sleep(0.3)
    report['without command'] = read['measured_cf']().wrench.force.z
    words = (
        'pause',
        'enable',
        'resume',
        'disable',
        'pause',
        'enable',
        'unhome',
        'home',
        'nonsense',
    )
    report['states'] = [arm.after(word) for word in words]
    report['around'] = around(arm)
    arm.to_state('disable', 'DISABLED')
    report['while disabled'] = servo(0.5, 0.3)
    pose = read['measured_cp']()
    report['frame'] = pose.header.frame_id
    report['position'] = [pose.pose.position.x, pose.pose.position.z]
    goal = client.stamped(PoseStamped())
    goal.pose.orientation.w, goal.pose.position.z = 1.0, 0.05
    hand.publish(goal)
    time.sleep(1.0)
    report['guided to'] = read['measured_cp']().pose.position.z
    report['messages'] = {name: len(newest.messages) for name, newest in read.items()}
    return report


def play_device(client, namespace, bridge):
    """A device of the bridge: sends poses, takes the force, and operates the bridge."""
    force = Newest(client, WrenchStamped, f'{namespace}/body/servo_cf')
    operated = Operated(client, bridge)
    measured_cp = client.publisher(PoseStamped, f'{namespace}/measured_cp')
    client.thread.start()
    client.check_connections()
    sending, stop = threading.Event(), threading.Event()
    sending.set()

    def send():
        while not stop.is_set():
            if sending.is_set():
                message = client.stamped(PoseStamped())
                message.pose.orientation.w = 1.0
                measured_cp.publish(message)
            time.sleep(0.001)

    thread = threading.Thread(target=send)
    thread.start()
    time.sleep(0.5)
    report = {'query': client.query(bridge), 'joined': asked(operated)}
    words = ('enable', 'pause', 'enable', 'resume', 'disable', 'enable')
    report['states'] = [operated.after(word) for word in words]
    report['around'] = around(operated)
    sending.clear()
    time.sleep(1.0)
    report['device silent'] = [operated.newest.state, *map(operated.after, ('enable', 'pause'))]
    sending.set()
    time.sleep(0.3)
    report['device back'] = [operated.newest.state, operated.to_state('enable', 'ENABLED')]
    report['force'] = max(abs(w.wrench.force.z) for w in force.messages)
    report['wrenches'] = len(force.messages)
    stop.set()
    thread.join()
    return report


if __name__ == '__main__':
    types, role, *namespaces = sys.argv[1:]
    plays = {'arm': play_with_arm, 'device': play_device}
    client = Client(types)
    try:
        print(json.dumps(plays[role](client, *namespaces)), flush=True)
    finally:
        client.close()
