"""A CRTK client that knows nothing of this project, for test_crtk_client.py.

Written after CRTK's description and its Python client: subscriptions and publishers are reliable,
keep last 10. It imports ROS alone. What it saw goes to standard output as JSON.

Arguments: NAMES_OF_TYPES_PACKAGE arm|device NAMESPACE [BRIDGE].
"""

import importlib
import json
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile
from sensor_msgs.msg import Joy

QOS = QoSProfile(depth=10, history=HistoryPolicy.KEEP_LAST)
CONNECTION = 30.0


class Client:
    """Utilities after crtk.utils: one attribute for each newest message."""

    def __init__(self, package):
        rclpy.init()
        self.node = rclpy.create_node('crtk_client')
        self.messages = importlib.import_module(f'{package}.msg')
        self.services = importlib.import_module(f'{package}.srv')
        self.seen = {}
        self.pairs = []
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.thread = threading.Thread(target=self.executor.spin)
        self.thread.start()

    def close(self):
        self.executor.shutdown()
        self.thread.join()
        self.node.destroy_node()
        rclpy.shutdown()

    def subscribe(self, kind, topic):
        self.seen[topic] = []
        handle = self.node.create_subscription(kind, topic, self.seen[topic].append, QOS)
        self.pairs.append((topic, lambda: self.node.count_publishers(handle.topic_name)))

    def publisher(self, kind, topic):
        handle = self.node.create_publisher(kind, topic, QOS)
        self.pairs.append((topic, handle.get_subscription_count))
        return handle

    def check_connections(self):
        deadline = time.monotonic() + CONNECTION
        while missing := [topic for topic, count in self.pairs if not count()]:
            if time.monotonic() > deadline:
                sys.exit(f'nobody is at the other end of {", ".join(missing)}')
            time.sleep(0.05)

    def operating_state(self, namespace):
        self.seen.setdefault(f'{namespace}/operating_state', [])
        kind = self.services.TriggerOperatingState
        query = self.node.create_client(kind, f'{namespace}/operating_state')
        if not query.wait_for_service(CONNECTION):
            sys.exit(f'there is no service {namespace}/operating_state')

        def ask():
            future = query.call_async(kind.Request())
            while not future.done():
                time.sleep(0.005)
            answer = future.result().operating_state
            return [answer.state, answer.is_homed, answer.is_busy]

        return ask

    def commander(self, namespace, ask):
        send = self.publisher(self.messages.StringStamped, f'{namespace}/state_command')

        def command(word):
            send.publish(self.messages.StringStamped(string=word))
            time.sleep(0.15)
            return ask()[0]

        return command


def stamp(node, message):
    message.header.stamp = node.get_clock().now().to_msg()
    return message


def play_with_arm(client, namespace):
    """A client of an arm: reads, commands a force, goes through the states."""
    for kind, name in (
        (PoseStamped, 'measured_cp'),
        (TwistStamped, 'measured_cv'),
        (WrenchStamped, 'measured_cf'),
        (client.messages.OperatingState, 'operating_state'),
        (Joy, 'button'),
    ):
        client.subscribe(kind, f'{namespace}/{name}')
    servo_cf = client.publisher(WrenchStamped, f'{namespace}/servo_cf')
    ask = client.operating_state(namespace)
    command = client.commander(namespace, ask)
    client.check_connections()
    felt = client.seen[f'{namespace}/measured_cf']

    def servo(newtons, seconds):
        """The largest force felt meanwhile: a machine that is held up may let go in between."""
        start = len(felt)
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            message = stamp(client.node, WrenchStamped())
            message.wrench.force.z = newtons
            servo_cf.publish(message)
            time.sleep(0.002)
        return max(message.wrench.force.z for message in felt[start:])

    report = {'at first': ask(), 'with command': servo(0.5, 0.5)}
    time.sleep(0.3)
    report['without command'] = felt[-1].wrench.force.z
    states = {}
    for word in ('pause', 'enable', 'resume', 'disable', 'pause', 'enable', 'unhome', 'home'):
        states[f'{len(states)} {word}'] = command(word)
    report['states'] = list(states.values())
    command('disable')
    report['while disabled'] = servo(0.5, 0.3)
    command('enable')
    pose = client.seen[f'{namespace}/measured_cp']
    report['rate'] = (len(pose) - 1) / max(seconds(pose[-1].header) - seconds(pose[0].header), 1e-9)
    report['frames'] = sorted({m.header.frame_id for m in pose})
    report['position'] = [pose[-1].pose.position.x, pose[-1].pose.position.z]
    report['messages'] = {t.rpartition('/')[2]: len(m) for t, m in client.seen.items()}
    return report


def seconds(header):
    return header.stamp.sec + 1e-9 * header.stamp.nanosec


def play_device(client, namespace, bridge):
    """A device of the bridge: sends poses, takes the force, and operates the bridge."""
    client.subscribe(WrenchStamped, f'{namespace}/body/servo_cf')
    client.subscribe(client.messages.OperatingState, f'{bridge}/operating_state')
    measured_cp = client.publisher(PoseStamped, f'{namespace}/measured_cp')
    ask = client.operating_state(bridge)
    command = client.commander(bridge, ask)
    client.check_connections()
    sending, stop = threading.Event(), threading.Event()
    sending.set()

    def send():
        while not stop.is_set():
            if sending.is_set():
                message = stamp(client.node, PoseStamped())
                message.pose.orientation.w = 1.0
                measured_cp.publish(message)
            time.sleep(0.001)

    thread = threading.Thread(target=send)
    thread.start()
    time.sleep(0.3)
    words = ('enable', 'pause', 'enable', 'resume', 'disable', 'enable')
    report = {'at first': ask(), 'states': [command(word) for word in words]}
    sending.clear()
    time.sleep(1.0)
    report['device silent'] = [ask()[0], command('enable'), command('pause')]
    sending.set()
    time.sleep(0.3)
    report['device back'] = [ask()[0], command('enable')]
    wrenches = client.seen[f'{namespace}/body/servo_cf']
    report['force'] = max(abs(w.wrench.force.z) for w in wrenches)
    report['wrenches'] = len(wrenches)
    report['announced'] = [m.state for m in client.seen[f'{bridge}/operating_state']]
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
