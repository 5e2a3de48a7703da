"""A live page without a graph: its server, a record of its requests, and a tissue to show.

Run `python -m bench.page.stand_in [--limited]`: serves in a process of its own, prints the link,
and answers each line of its standard input with the requests so far.
"""

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from collections import Counter, deque
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import numpy as np

from bench.common.processes import children_of
from cutting_trainer.viewer.access_control import PageLimits, link, make_gate
from cutting_trainer.viewer.allowed_requests import Bounds, LiveControls
from cutting_trainer.viewer.page_protocol import AnyMessage, EStop
from cutting_trainer.viewer.page_server import PageServer

TOKEN = 'of-this-test'
GATE = make_gate('127.0.0.1', [], TOKEN)
SIDE = 100
"""Squares along an edge of a sheet of 20,000 triangles."""
CONTROLS = LiveControls(
    scenes=('block', 'liver'),
    methods=('combined', 'delete'),
    scale=(0.1, 3.0),
    bounds=Bounds((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2)),
    session=True,
    can_guide=True,
    exercises={'circle': 'Precision cutting'},
    bags=('circle-1', 'circle-2'),
)
UNLIMITED = PageLimits(rate=1e9, burst=1e9, byte_rate=1e12, byte_burst=1e12, openings=1e9)
"""No limits, so that every message reaches the protocol."""
HERE = (0.01, 0.0, 0.02)
VALID: dict[str, dict[str, Any]] = {
    'e_stop': {},
    'reset_e_stop': {},
    'start': {},
    'pause': {},
    'reset': {},
    'record': {'on': True},
    'choose': {'scene': 'liver', 'method': 'delete'},
    'attempt': {'scene': 'circle', 'subject': 'p-01'},
    'watch': {'bags': ['circle-1', 'circle-2'], 'number': 1},
    'scale': {'value': 1.5},
    'guide': {'position': HERE, 'wxyz': (1.0, 0.0, 0.0, 0.0)},
}
"""One valid message of each control of a live page."""
INSTRUCTORS: dict[str, dict[str, Any]] = {
    'hold': {'on': True},
    'tissue': {'stiffness': 1.5, 'toughness': 0.5},
}
"""The same of those that only the page of an instructor has."""


class StandIn:
    """Server whose actions record requests and their times [ns].

    Args:
        controls: allowed requests.
        limits: of pages.
    """

    def __init__(self, controls: LiveControls = CONTROLS, limits: PageLimits | None = None) -> None:
        self.asked: deque[AnyMessage] = deque(maxlen=1000)
        self.counts: Counter[str] = Counter()
        self.stopped: deque[float] = deque(maxlen=1000)
        self.server = PageServer('127.0.0.1', 0, GATE, 'live', controls, self._act, limits)
        port = self.server.port
        self.url = link('127.0.0.1', port, [], TOKEN)
        self.instructor = link('127.0.0.1', port, [], GATE.instructor_token, 'instructor')

    def _act(self, message: AnyMessage) -> None:
        if isinstance(message, EStop):
            self.stopped.append(time.perf_counter())
        self.asked.append(message)
        self.counts[message.op] += 1


class OtherProcess:
    """A stand-in in a process of its own; use it as a context manager.

    Args:
        limited: with the limits of a real page; else without any of rates.

    Attributes:
        url: of the page.
        pid: of the process.
    """

    def __init__(self, *, limited: bool) -> None:
        command = [sys.executable, '-m', __spec__.name, *(['--limited'] if limited else [])]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )
        self.pid = self._process.pid
        self.url = self._read()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def _read(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def report(self) -> Any:
        """Return `asked`, counts by op, `stopped`, times of E-STOPs [s], and `threads`."""
        assert self._process.stdin is not None
        self._process.stdin.write('\n')
        return self._read()

    @property
    def memory(self) -> float:
        """Memory of the process [MB]."""
        return resident(self.pid)

    @property
    def children(self) -> int:
        """Number of its running child processes."""
        return len(children_of(self.pid))

    @property
    def connections(self) -> int:
        """Number of its internet sockets that do not belong to its own port."""
        port = int(self.url.rpartition('/')[0].rpartition(':')[2])
        own = {str(fd.readlink()) for fd in Path(f'/proc/{self.pid}/fd').iterdir()}
        lines = [
            line.split()
            for kind in ('tcp', 'tcp6', 'udp', 'udp6')
            for line in Path(f'/proc/{self.pid}/net/{kind}').read_text().splitlines()[1:]
        ]
        return sum(
            f'socket:[{words[9]}]' in own and int(words[1].rpartition(':')[2], 16) != port
            for words in lines
        )


def resident(process: int | str = 'self') -> float:
    """Return the memory of a process [MB]."""
    pages = int(Path(f'/proc/{process}/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 1e6


def sheet() -> SimpleNamespace:
    """Return a tissue as far as it is drawn: a flat sheet."""
    line = np.linspace(0.0, 0.1, SIDE + 1)
    x, y = np.meshgrid(line, line)
    rest = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    a = (np.arange(SIDE)[:, None] * (SIDE + 1) + np.arange(SIDE)).ravel()
    b, c, d = a + 1, a + SIDE + 1, a + SIDE + 2
    triangles = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]).astype(np.int32)
    return SimpleNamespace(
        rest=rest,
        displacement=np.zeros_like(rest),
        triangles=triangles,
        triangle_kind=np.zeros(len(triangles), np.uint8),
        revision=0,
    )


def wave(tissue: SimpleNamespace) -> None:
    """Show the next frame."""
    tissue.revision += 1
    tissue.displacement[:, 2] = 1e-5 * tissue.revision


def main() -> None:
    """Serve until the standard input ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--limited', action='store_true')
    stand_in = StandIn(limits=None if parser.parse_args().limited else UNLIMITED)
    print(json.dumps(stand_in.url), flush=True)
    for _ in sys.stdin:
        report = {'asked': dict(stand_in.counts), 'stopped': list(stand_in.stopped)}
        print(json.dumps(report | {'threads': threading.active_count()}), flush=True)
    stand_in.server.stop()


if __name__ == '__main__':
    main()
