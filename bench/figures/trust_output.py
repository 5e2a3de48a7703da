"""Line 4: effect of an unread log on the 1 kHz loops, and answers of the bridge meanwhile."""

import fcntl
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor

from bench.figures.figure import Figure
from cutting_trainer.node_common.operating_state import E_STOP, CrtkState, crtk_types
from cutting_trainer.node_common.qos import EVENTS
from cutting_trainer.node_common.share_folder import SCENES
from cutting_trainer.node_common.timing import MAX_TIMELY_LATENESS_S
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.node_commands import ARM_NODE, BRIDGE_NODE, MODULES, node_environment

PIPE_BYTES = 4096
"""Smallest size of a pipe: full after a second."""
SLICE_S, SLICES = 0.5, 12
"""Quiet and logging slices alternate, so that other load of the machine is in both."""
LONG_SLICE_S = 10.0
"""Of the long version: a pipe is full after a second, and unread for the rest."""
QUERIES = 20
ANSWER_TIMEOUT_S = 1.0
START_TIMEOUT_S = 30.0
WORST_RATIO = 2.0
PARAMETERS: dict[str, tuple[str, ...]] = {
    ARM_NODE: ('-p', 'wait_for_bridge:=false'),
    BRIDGE_NODE: ('-p', 'auto_enable:=true'),
}


@dataclass(frozen=True)
class Seen:
    """Result of a run with unread pipes.

    Attributes:
        lateness: by node, p99.9 [s] of the deadlines of quiet slices and of the others; infinite
            where the node never came to their end.
        usual: the same as the median of the slices' own p99.9: a moment in which the machine
            stands still is in one slice only.
        deadlines: by node, their numbers.
        answers: [s] of each query that the bridge answered.
        stopped: the bridge was in FAULT after an E-STOP among the last queries.
    """

    lateness: dict[str, tuple[float, float]]
    usual: dict[str, tuple[float, float]]
    deadlines: dict[str, tuple[int, int]]
    answers: list[float]
    stopped: bool


def measure() -> list[Figure]:
    """Return the figures of line 4."""
    seen = watch((BRIDGE_NODE, ARM_NODE), SLICE_S, SLICES, QUERIES)
    figures = []
    for name, (quiet, unread) in seen.usual.items():
        reference = max(quiet, MAX_TIMELY_LATENESS_S)
        figures.append(
            Figure(
                line=4,
                name=f'lateness of {name}, p99.9 of a usual half second: log that nobody reads',
                value=unread / reference,
                bound=WORST_RATIO,
                side='at most',
                unit='',
                samples=round(SLICE_S * SLICES / 2 * 1000),
                reference='that of its quiet half seconds, at least the 0.5 ms of a timely tick',
                absolute=f'{unread * 1e3:.2f} ms, quiet {quiet * 1e3:.2f} ms',
            )
        )
    answered = sum(answer < ANSWER_TIMEOUT_S for answer in seen.answers)
    figures.append(
        Figure(
            line=4,
            name='queries that the bridge answers within 1 s while nobody reads its log',
            value=answered,
            bound=QUERIES,
            side='at least',
            unit='',
            samples=QUERIES,
        )
    )
    return figures


def watch(names: Sequence[str], slice_s: float, slices: int, queries: int) -> Seen:
    """Run nodes that log into unread pipes, and query the bridge meanwhile.

    Args:
        names: of nodes; the bridge is one of them.
        slice_s: of a quiet or logging slice [s].
        slices: how many, quiet ones first.
        queries: to the bridge, over the whole time.
    """
    with tempfile.TemporaryDirectory() as name, reserved_domain('free') as domain:
        folder = Path(name)
        with _unread(names, folder, slice_s, slices, domain), _Operator(domain) as operator:
            operator.wait_for_bridge()
            spent = [operator.ask() for _ in _times(queries, slice_s * slices)]
            stopped = operator.stops()
            results = {name: folder / f'{name}.npz' for name in names}
            until = time.monotonic() + slice_s + 5.0
            while not all(map(Path.exists, results.values())) and time.monotonic() < until:
                time.sleep(0.05)
            answers = [took for took in spent if took is not None]
            return _seen(results, slices // 2, answers, stopped)


def _times(count: int, seconds: float) -> Iterator[int]:
    began = time.monotonic()
    for number in range(count):
        yield number
        time.sleep(max(began + (number + 1) * seconds / count - time.monotonic(), 0.0))


def _seen(results: Mapping[str, Path], slices: int, answers: list[float], stopped: bool) -> Seen:
    lateness, usual, deadlines = {}, {}, {}
    for name, path in results.items():
        lateness[name] = usual[name] = np.inf, np.inf
        deadlines[name] = 0, 0
        if path.exists():
            with np.load(path) as saved:
                parts = saved['quiet'], saved['unread']
            deadlines[name] = len(parts[0]), len(parts[1])
            if all(deadlines[name]):
                lateness[name] = _p999(parts[0]), _p999(parts[1])
                usual[name] = _usual(parts[0], slices), _usual(parts[1], slices)
    return Seen(lateness, usual, deadlines, answers, stopped)


def _p999(lateness: np.ndarray) -> float:
    return float(np.percentile(lateness, 99.9))


def _usual(lateness: np.ndarray, slices: int) -> float:
    return float(np.median([_p999(part) for part in np.array_split(lateness, slices)]))


@contextmanager
def _unread(
    names: Sequence[str], folder: Path, slice_s: float, slices: int, domain: int
) -> Iterator[None]:
    """Run nodes whose output goes to unread pipes."""
    scene = SCENES / 'block.yaml'
    processes, readers = [], []
    try:
        for name in names:
            reader, writer = os.pipe()
            fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
            readers.append(reader)
            argv = [sys.executable, '-m', 'bench.figures.chatty_node', MODULES[name]]
            argv += [str(folder / f'{name}.npz'), str(slice_s), str(slices), '--ros-args']
            argv += ['-p', f'scene:={scene}', '-p', f'bag:={folder / "bag"}']
            argv += PARAMETERS.get(name, ())
            environment = node_environment(domain)
            processes.append(subprocess.Popen(argv, stdout=writer, stderr=writer, env=environment))
            os.close(writer)
        yield
    finally:
        for process in processes:
            process.send_signal(signal.SIGINT)
        for process in processes:
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for reader in readers:
            os.close(reader)


class _Operator:
    """Query the state of the bridge, and press E-STOP; a context manager."""

    def __init__(self, domain: int) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node: Any = rclpy.create_node('operator', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        types = crtk_types()
        self._types = types
        self._query = self._node.create_client(types.query, f'{BRIDGE_NODE}/operating_state')
        self._commands = self._node.create_publisher(
            types.command, f'{BRIDGE_NODE}/state_command', EVENTS
        )

    def __enter__(self) -> '_Operator':
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def wait_for_bridge(self) -> None:
        """Wait until the bridge answers, or a timeout."""
        until = time.monotonic() + START_TIMEOUT_S
        while self.ask() is None and time.monotonic() < until:
            time.sleep(0.05)

    def ask(self) -> float | None:
        """Return the answer time of a query [s]; None: too late."""
        began = time.monotonic()
        return None if self._state() is None else time.monotonic() - began

    def stops(self) -> bool:
        """Return whether the bridge is in FAULT soon after an E-STOP."""
        self._commands.publish(self._types.command(string=E_STOP))
        until = time.monotonic() + ANSWER_TIMEOUT_S
        while (state := self._state()) is not None and time.monotonic() < until:
            if state == CrtkState.FAULT:
                return True
        return False

    def _state(self) -> str | None:
        if not self._query.wait_for_service(timeout_sec=0.2):
            return None
        future = self._query.call_async(self._types.query.Request())
        self._executor.spin_until_future_complete(future, timeout_sec=ANSWER_TIMEOUT_S)
        if not future.done():
            return None
        return str(future.result().operating_state.state)


if __name__ == '__main__':  # SECONDS of each kind: every node, as the figure's long version
    half = round(float(sys.argv[1]) / LONG_SLICE_S)
    print(watch(tuple(MODULES), LONG_SLICE_S, 2 * half, round(2 * half * LONG_SLICE_S)))
