"""Run a node that logs 50 lines a second in every other slice of time, and save its lateness.

    python -m bench.figures.chatty_node MODULE RESULT SLICE SLICES --ros-args ...

RESULT is a .npz with the lateness [s] of every deadline of the quiet slices and of the others, each
SLICE [s] long. A deadline that was missed is as late as the tick that came instead of it.
"""

import sys
import threading
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from cutting_trainer.node_common.lifecycle import ManagedNode

LINES_A_SECOND = 50
COPY_PERIOD_S = 0.5
"""Period of the copies of the newest ticks; a loop keeps the last four seconds."""
TEXT = 'a line that this node logs fifty times a second, with or without a reader: number'


class Lateness:
    """Collect the lateness of each deadline of a loop."""

    def __init__(self, loop: Any) -> None:
        self._loop, self._seen = loop, loop.ticks

    def news(self) -> np.ndarray:
        """Return the lateness [s] of the deadlines since the last call, shape (n,)."""
        loop, ticks = self._loop, self._loop.ticks
        late = np.array(loop._lateness)[np.arange(self._seen, ticks) % len(loop._lateness)]
        self._seen = ticks
        missed = np.maximum(late, 0) // loop.period_ns
        behind = np.concatenate([np.arange(count + 1) for count in missed] or [np.zeros(0)])
        return np.asarray((np.repeat(late, missed + 1) - behind * loop.period_ns) * 1e-9)


def chat(node: Any, result: str, slice_s: float, slices: int) -> None:
    """Be quiet and log by turns, and save the lateness of the loop in both."""
    seen: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    loop = getattr(node, '_loop', None)
    lateness = loop and Lateness(loop)
    said = 0
    for number in range(slices):
        end, look = time.monotonic() + slice_s, time.monotonic() + COPY_PERIOD_S
        while (now := time.monotonic()) < end:
            if number % 2:
                said += 1
                node.get_logger().info(f'{TEXT} {said}')
            time.sleep(1 / LINES_A_SECOND)
            if lateness and now >= look:
                look = now + COPY_PERIOD_S
                seen[number % 2].append(lateness.news())
        if lateness:
            seen[number % 2].append(lateness.news())
    quiet, unread = (np.concatenate(part or [np.zeros(0)]) for part in seen)
    np.savez(f'{result}.part.npz', quiet=quiet, unread=unread, said=said)
    Path(f'{result}.part.npz').rename(result)


def main() -> None:
    """Run the node, with a thread that logs."""
    module, result, slice_s, slices = sys.argv[1:5]
    del sys.argv[1:5]
    announce = ManagedNode.serve

    def serve(node: ManagedNode, stop: Any) -> None:
        if node.is_active:
            arguments = (node, result, float(slice_s), int(slices))
            threading.Thread(target=chat_when_at_work, args=arguments, daemon=True).start()
            ManagedNode.serve = announce  # type: ignore[method-assign]
        announce(node, stop)

    ManagedNode.serve = serve  # type: ignore[method-assign]
    import_module(module).main()


def chat_when_at_work(node: Any, *arguments: Any) -> None:
    """Log once the node has worked for a moment."""
    before = node.progress
    while node.progress < before + 200:
        time.sleep(0.05)
    chat(node, *arguments)


if __name__ == '__main__':
    main()
