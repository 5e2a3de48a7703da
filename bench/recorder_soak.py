"""The recorder at full rate: nothing lost, memory flat, how much of a core, and what it costs a
1 kHz loop. Run `python -m bench.recorder_soak [SECONDS]` (default 600).

One process publishes poses and wrenches at 1 kHz and, at 30 Hz, deltas of a mesh of 20 000
tetrahedra (4 500 nodes, all displaced). First alone, then with the recorder beside it.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import rclpy
from cutting_trainer_msgs.msg import MeshDelta
from geometry_msgs.msg import PoseStamped, WrenchStamped

from bags.reader import open_bag
from haptic_bridge.wire import PoseStampedCodec, WrenchStampedCodec
from session.domain import reserved_domain
from session.graph import node_environment, recorder_command
from tissue_sim.messages import packed
from tissue_sim.ros import MESH_UPDATES, STREAM, UPDATES
from tissue_sim.timing import PeriodicLoop

NODES = 4500
BETWEEN_DELTAS = 33
ALONE = 20.0


def main(seconds: float) -> None:
    """Prints one line a measure."""
    with reserved_domain('free') as domain, tempfile.TemporaryDirectory() as temporary:
        os.environ.update(node_environment(domain))
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=domain)
        source = Source(context)
        alone = source.publish(min(ALONE, seconds))
        bag = Path(temporary) / 'bag'
        recorder = subprocess.Popen(
            recorder_command(None, bag, 0).argv, stdout=subprocess.PIPE, text=True
        )
        assert recorder.stdout is not None
        while 'ready' not in recorder.stdout.readline():
            pass
        time.sleep(2.0)
        before, memory = cpu_seconds(recorder.pid), []
        counts = dict(source.sent)
        beside = source.publish(seconds, lambda: memory.append(resident(recorder.pid)))
        used = cpu_seconds(recorder.pid) - before
        time.sleep(1.0)
        recorder.send_signal(signal.SIGINT)
        said = recorder.communicate(timeout=60)[0]
        read: dict[str, int] = {}
        for message in open_bag(bag).messages(list(source.sent)):
            read[message.topic] = read.get(message.topic, 0) + 1
        for topic, count in source.sent.items():
            print(f'{topic}: sent {count - counts[topic]}, in the bag {read.get(topic, 0)}')
        print(said.splitlines()[0])
        third = max(len(memory) // 3, 1)
        early, late = np.mean(memory[third : 2 * third]), np.mean(memory[-third:])
        print(f'memory: {early:.1f} MB in the second third, {late:.1f} MB in the last')
        print(f'recorder: {100 * used / seconds:.1f} % of a core')
        ratio = beside['lateness_p99'] / alone['lateness_p99']
        print(f'1 kHz loop: late p99 {beside["lateness_p99"] * 1e3:.3f} ms, {ratio:.2f} x alone')
        rclpy.shutdown(context=context)


class Source:
    """Publishes at full rate."""

    def __init__(self, context: rclpy.Context) -> None:
        node = rclpy.create_node('source', context=context)
        self._node = node
        self._pose = node.create_publisher(PoseStamped, '/arm/measured_cp', STREAM)
        self._wrench = node.create_publisher(WrenchStamped, '/arm/servo_cf', STREAM)
        self._delta = node.create_publisher(MeshDelta, f'/{MESH_UPDATES}', UPDATES)
        self._message = MeshDelta(node_count=NODES)
        self._message.displacement = packed('d', np.random.default_rng(0).random(3 * NODES))
        self.sent = {'/arm/measured_cp': 0, '/arm/servo_cf': 0, f'/{MESH_UPDATES}': 0}

    def publish(self, seconds: float, look: object = None) -> dict[str, float]:
        """Publishes for a time [s]; returns how the loop kept its deadlines."""
        loop = PeriodicLoop(1000.0, window=1 << 20)
        pose, wrench = PoseStampedCodec('arm_base'), WrenchStampedCodec('arm_base')
        loop.start()
        for tick in range(round(seconds * 1000)):
            loop.wait()
            now = time.time_ns()
            self._pose.publish(pose.encode(now, (0.1, 0.2, tick * 1e-6, 0.0, 0.0, 0.0, 1.0)))
            self._wrench.publish(wrench.encode(now, (0.0, 0.0, tick * 1e-6, 0.0, 0.0, 0.0)))
            self.sent['/arm/measured_cp'] += 1
            self.sent['/arm/servo_cf'] += 1
            if tick % BETWEEN_DELTAS == 0:
                self._message.revision = tick
                self._delta.publish(self._message)
                self.sent[f'/{MESH_UPDATES}'] += 1
            if callable(look) and tick % 1000 == 0:
                look()
        return loop.report()


def cpu_seconds(process: int) -> float:
    """User and system time of a process [s]."""
    fields = Path(f'/proc/{process}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def resident(process: int) -> float:
    """Memory of a process [MB]."""
    pages = int(Path(f'/proc/{process}/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 1e6


if __name__ == '__main__':
    main(float(sys.argv[1]) if sys.argv[1:] else 600.0)
