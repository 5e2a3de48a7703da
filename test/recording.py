"""A recorder as a process, and a node that publishes what it records."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import rclpy
from live import PATIENCE, ROOT, free_domain
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from cutting_trainer.node_common.ros import ARM

DOMAIN = free_domain()
MEASURED_CP = f'{ARM}/measured_cp'


@contextmanager
def source() -> Iterator[Node]:
    """A node that publishes what is recorded, and is served meanwhile."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    node = Node('source', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    stop = threading.Event()

    def spin() -> None:
        while not stop.is_set():
            executor.spin_once(timeout_sec=0.05)

    spinner = threading.Thread(target=spin)
    spinner.start()
    yield node
    stop.set()
    spinner.join()
    node.destroy_node()
    rclpy.shutdown(context=context)


class RecorderProcess:
    """A recorder of its own process, ready to hear."""

    def __init__(self, folder: Path, **parameters: object) -> None:
        self.folder = folder
        settings = [f'{key}:={value}' for key, value in ({'bag': folder} | parameters).items()]
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'cutting_trainer.bags.recorder_node', '--ros-args']
            + [word for setting in settings for word in ('-p', setting)],
            cwd=ROOT,
            env=os.environ | {'ROS_DOMAIN_ID': str(DOMAIN), 'PYTHONUNBUFFERED': '1'},
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == 'ready: recorder\n'

    def end(self, number: int = signal.SIGINT) -> str:
        """Sends a signal; returns what the recorder said after it was ready."""
        self.process.send_signal(number)
        said, _ = self.process.communicate(timeout=PATIENCE)
        return said
