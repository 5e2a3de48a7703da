"""A recorder that is killed: what it has heard is in the bag, and the bag can be repaired."""

import itertools
import random
import threading
import time
from collections.abc import Callable, Container, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from cutting_trainer_msgs.msg import Contact, MeshDelta
from geometry_msgs.msg import PoseStamped
from live import wait_for
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from recording import MEASURED_CP, RecorderProcess, source
from std_msgs.msg import Header

from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.repair import repair_bag
from cutting_trainer.node_common.qos import UPDATES
from cutting_trainer.node_common.ros import CONTACT, MESH_UPDATES

pytestmark = [pytest.mark.real_time, pytest.mark.thorough]


@pytest.fixture
def node() -> Iterator[Node]:
    with source() as node:
        yield node


class Streams(threading.Thread):
    """Publishes on three topics, two at 1 kHz and the mesh at 30 Hz, and keeps what it sent, when.

    Attributes:
        sent: time [ns since the epoch] at which it was out, and bytes of each message, by topic.
    """

    def __init__(self, node: Node) -> None:
        super().__init__()
        self.sent: dict[str, list[tuple[int, bytes]]] = {}
        self._publishers = [
            (node.create_publisher(PoseStamped, f'/{MEASURED_CP}', QoSProfile(depth=1000)), 1),
            (node.create_publisher(Contact, f'/{CONTACT}', QoSProfile(depth=1000)), 1),
            (node.create_publisher(MeshDelta, f'/{MESH_UPDATES}', UPDATES), 33),
        ]
        self._ended = threading.Event()

    def run(self) -> None:
        displacement = [random.Random(2).random() for _ in range(3000)]
        kinds: list[Callable[[int], Any]] = [
            lambda i: PoseStamped(header=Header(frame_id=f'device {i}')),
            lambda i: Contact(sequence=i),
            lambda i: MeshDelta(revision=i, displacement=displacement),
        ]
        deadline = time.monotonic()
        for i in itertools.count():
            for (publisher, every), make in zip(self._publishers, kinds, strict=True):
                if i % every == 0:
                    data = serialize_message(make(i))
                    publisher.publish(data)
                    self.sent.setdefault(publisher.topic, []).append((time.time_ns(), data))
            deadline += 0.001
            time.sleep(max(0.0, deadline - time.monotonic()))
            if self._ended.is_set():
                return

    def end(self) -> None:
        self._ended.set()
        self.join()


def held_up(process: int) -> int:
    """How long [ns] the threads of a process have waited for a processor since they began."""
    tasks = Path(f'/proc/{process}/task').iterdir()
    return sum(int((task / 'schedstat').read_text().split()[1]) for task in tasks)


def hears_all(folder: Path) -> bool:
    """Whether messages of all streams come without delay: the first may take a second."""
    time.sleep(0.4)  # to read a bag takes the processor from the streams
    age = {m.topic: m.log_time - m.publish_time for m in open_bag(folder).messages()}
    return all(age.get(f'/{topic}', 1e9) < 1e8 for topic in (MEASURED_CP, CONTACT, MESH_UPDATES))


def kill_while_it_records(folder: Path, delay: float) -> int:
    """Starts a recorder, and kills it some time [s] after its first messages.

    Returns:
        When [ns since the epoch], less the time for which it had no processor while it recorded.
    """
    recorder = RecorderProcess(folder, seed=11)
    try:
        before = held_up(recorder.process.pid)
        wait_for(lambda: hears_all(folder), 'the recorder to hear all')
        time.sleep(delay)
        return time.time_ns() - (held_up(recorder.process.pid) - before)
    finally:
        recorder.process.kill()
        recorder.process.communicate()


def as_sent(data: bytes, lengths: list[int], sent: Container[bytes]) -> bytes:
    """A message without the up to three bytes by which RTPS fills its last word."""
    shorter = (data[:length] for length in lengths if length <= len(data) < length + 4)
    return next((some for some in shorter if some in sent), data)


def test_a_recorder_killed_twenty_times_leaves_all_but_the_last_half_second_bit_for_bit(
    node: Node, tmp_path: Path
) -> None:
    draw, streams = random.Random(4), Streams(node)
    streams.start()
    folders = [tmp_path / f'bag{i}' for i in range(20)]
    delays = [draw.uniform(0.0, 0.6) for _ in folders]
    try:
        with ThreadPoolExecutor(2) as several:
            killed = list(several.map(kill_while_it_records, folders, delays))
    finally:
        streams.end()
    for folder, end in zip(folders, killed, strict=True):
        assert not open_bag(folder).complete
        assert not repair_bag(folder).whole
        bag = open_bag(folder)
        assert bag.complete and bag.custom_data['seed'] == '11'
        for topic, sent in streams.sent.items():
            times, all_sent = zip(*sent, strict=True)
            kept = [m.data for m in bag.messages([topic])]
            # A process that waits for a processor may lose some on the way: counted elsewhere.
            place = {data: i for i, data in enumerate(all_sent)}
            lengths = sorted({len(data) for data in all_sent})
            places = [place[as_sent(data, lengths, place)] for data in kept]
            assert places == sorted(set(places))
            missing = times[places[-1] + 1 :]
            assert not missing or missing[0] > end - 5e8
