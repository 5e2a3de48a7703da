"""The recorder at full rate: nothing lost, memory flat, how much of a core, and what it costs a
1 kHz loop. Run `python -m bench.graph.recorder_soak [SECONDS] [--plain]` (default 600 s).

Three processes stand for a session: this one publishes poses and wrenches at 1 kHz from a loop set
up as the trainer's are (`--plain`: without real-time scheduling), a second one deltas of a mesh of
20 000 tetrahedra (4 500 nodes, all displaced) at 30 Hz, a third one hears all of it, as the other
nodes of a session do. First without a recorder, then with it, then without it again.
"""

import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from cutting_trainer_msgs.msg import MeshDelta
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node

from cutting_trainer.bags.reader import open_bag
from cutting_trainer.node_common.cdr_codec import PoseStampedCodec, WrenchStampedCodec
from cutting_trainer.node_common.qos import NEWEST_BEST_EFFORT, STREAM, UPDATES
from cutting_trainer.node_common.realtime import prepare
from cutting_trainer.node_common.ros import MESH_UPDATES, polled, take_raw
from cutting_trainer.node_common.timing import PeriodicLoop
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.node_commands import node_environment, recorder_command
from cutting_trainer.tissue_sim.streaming.messages import packed

NODES = 4500
LOOP_ALONE_S = 30.0
POSE, WRENCH, DELTA = '/arm/measured_cp', '/arm/servo_cf', f'/{MESH_UPDATES}'
FIGURES = ('lateness_p50', 'lateness_p99', 'lateness_p999', 'busy_p50')


def main(seconds: float, *, real_time: bool) -> None:
    """Print one line a measure."""
    start = multiprocessing.get_context('spawn')
    deltas = start.Value('Q', 0)
    with reserved_domain('free') as domain, tempfile.TemporaryDirectory() as temporary:
        os.environ.update(node_environment(domain))
        others = [
            start.Process(target=publish_deltas, args=(domain, deltas), daemon=True),
            start.Process(target=hear, args=(domain,), daemon=True),
        ]
        for process in others:
            process.start()
        with a_node('device', domain) as node:
            source = Source(node)
            time.sleep(5.0)
            if real_time:
                print(prepare())
            before = source.publish(min(LOOP_ALONE_S, seconds))
            beside, said, read, sent = beside_recorder(
                source, deltas, Path(temporary) / 'bag', seconds
            )
            after = source.publish(min(LOOP_ALONE_S, seconds))
        for process in others:
            process.terminate()
    for topic, (first, last) in sent.items():
        print(f'{topic}: sent {last - first}, in the bag {read.get(topic, 0)}')
    print(said)
    alone = {name: (before[name] + after[name]) / 2 for name in FIGURES}
    for name in FIGURES:
        quantity, _, quantile = name.partition('_')
        print(
            f'1 kHz loop, {quantity} {quantile}: {beside[name] * 1e3:.3f} ms with the recorder, '
            f'{beside[name] / alone[name]:.2f} times without '
            f'({before[name] * 1e3:.3f} ms before, {after[name] * 1e3:.3f} ms after)'
        )


def beside_recorder(
    source: 'Source', deltas: 'Synchronized[int]', bag: Path, seconds: float
) -> tuple[dict[str, float], str, dict[str, int], dict[str, tuple[int, int]]]:
    """Return the loop beside a recorder.

    Returns:
        Lateness of the loop; report and resources of the recorder, in lines; messages in the
        bag, and sent by when the time began and ended, by topic.
    """
    recorder = subprocess.Popen(
        recorder_command(None, bag, 0).argv, stdout=subprocess.PIPE, text=True
    )
    assert recorder.stdout is not None
    while 'ready' not in recorder.stdout.readline():
        pass
    time.sleep(2.0)
    used, memory = -cpu_seconds(recorder.pid), []
    first = source.sent | {DELTA: deltas.value}
    figures = source.publish(seconds, lambda: memory.append(resident(recorder.pid)))
    used += cpu_seconds(recorder.pid)
    last = source.sent | {DELTA: deltas.value}
    time.sleep(1.0)
    recorder.send_signal(signal.SIGINT)
    said = recorder.communicate(timeout=60)[0]
    third = max(len(memory) // 3, 1)
    early, late = np.mean(memory[third : 2 * third]), np.mean(memory[-third:])
    lines = [
        said.splitlines()[0],
        f'memory: {early:.1f} MB in the second third, {late:.1f} MB in the last',
        f'recorder: {100 * used / seconds:.1f} % of a core',
    ]
    read: dict[str, int] = {}
    for message in open_bag(bag).messages(list(first)):
        within = message.topic != DELTA or first[DELTA] < message.sequence <= last[DELTA]
        read[message.topic] = read.get(message.topic, 0) + within
    return figures, '\n'.join(lines), read, {topic: (first[topic], last[topic]) for topic in first}


@contextmanager
def a_node(name: str, domain: int) -> Iterator[Node]:
    """Yield a node of this process."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node(name, context=context)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


class Source:
    """Publish poses and wrenches at full rate."""

    def __init__(self, node: Node) -> None:
        self._pose = node.create_publisher(PoseStamped, POSE, STREAM)
        self._wrench = node.create_publisher(WrenchStamped, WRENCH, STREAM)
        self.sent = {POSE: 0, WRENCH: 0}

    def publish(self, seconds: float, look: Callable[[], Any] = lambda: None) -> dict[str, float]:
        """Publish for a time [s]; return the lateness of the loop."""
        loop = PeriodicLoop(1000.0, window=1 << 20)
        pose, wrench = PoseStampedCodec('arm_base'), WrenchStampedCodec('arm_base')
        loop.start()
        for tick in range(round(seconds * 1000)):
            loop.wait()
            now = time.time_ns()
            self._pose.publish(pose.encode(now, (0.1, 0.2, tick * 1e-6, 0.0, 0.0, 0.0, 1.0)))
            self._wrench.publish(wrench.encode(now, (0.0, 0.0, tick * 1e-6, 0.0, 0.0, 0.0)))
            for topic in self.sent:
                self.sent[topic] += 1
            if tick % 1000 == 0:
                look()
        return loop.report()


def publish_deltas(domain: int, sent: 'Synchronized[int]') -> None:
    """Publish deltas for ever; a process of its own, as the simulation is."""
    with a_node('tissue_sim', domain) as node:
        publisher = node.create_publisher(MeshDelta, DELTA, UPDATES)
        message = MeshDelta(node_count=NODES)
        message.displacement = packed('d', np.random.default_rng(0).random(3 * NODES))
        loop = PeriodicLoop(30.0)
        loop.start()
        while True:
            loop.wait()
            message.revision += 1
            publisher.publish(message)
            sent.value += 1


def hear(domain: int) -> None:
    """Subscribe as the other nodes of a session do."""
    with a_node('listener', domain) as node:
        subscriptions = [
            polled(node, PoseStamped, POSE, NEWEST_BEST_EFFORT),
            polled(node, WrenchStamped, WRENCH, NEWEST_BEST_EFFORT),
            polled(node, MeshDelta, DELTA, UPDATES),
        ]
        loop = PeriodicLoop(1000.0)
        loop.start()
        while True:
            loop.wait()
            for subscription in subscriptions:
                take_raw(subscription)


def cpu_seconds(process: int) -> float:
    """Return user and system time of a process [s]."""
    fields = Path(f'/proc/{process}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def resident(process: int) -> float:
    """Return memory of a process [MB]."""
    pages = int(Path(f'/proc/{process}/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 1e6


if __name__ == '__main__':
    numbers = [word for word in sys.argv[1:] if not word.startswith('-')]
    main(float(numbers[0]) if numbers else 600.0, real_time='--plain' not in sys.argv[1:])
