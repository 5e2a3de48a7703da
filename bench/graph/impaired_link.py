"""Two hosts on one machine: network namespaces, joined by a link with impairments.

Each namespace has one network device of kind TUN, and a process of its own carries the IP packets
from one to the other: late, in another order, or not at all. `tc netem`, which does the same in the
kernel, is not part of every kernel. Needs the rights of root and `/dev/net/tun`.

Run as `python -m bench.graph.impaired_link A B NAME_A NAME_B SECONDS...` by `TwoHosts` only.
"""

import contextlib
import fcntl
import heapq
import json
import os
import random
import select
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

_TUNSETIFF = 0x400454CA
_IFF_TUN, _IFF_NO_PI = 0x0001, 0x1000
MTU_BYTES = 1500
"""Largest packet [bytes], as on Ethernet."""
REORDER_DELAY_S = 0.01
"""Additional delay of a reordered packet [s]."""
_MAX_QUEUE = 1 << 14
"""Longest queue of packets: further ones are lost, as in any router."""


@dataclass(frozen=True)
class Impairment:
    """Impairment of the link, in each direction independently.

    Attributes:
        delay: of every packet [s].
        jitter: largest further delay [s], uniform; packets keep their order.
        loss: share of packets that never come.
        reorder: share of packets that those behind them overtake.
        rate: bytes that pass in a second; 0: as many as come.
    """

    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    reorder: float = 0.0
    rate: float = 0.0


def missing_rights() -> str:
    """Return the reason why two hosts cannot be made here, as a sentence; '' if they can."""
    if os.geteuid() != 0:
        return 'network namespaces need the rights of root'
    if shutil.which('ip') is None:
        return 'the program ip (iproute2) is not installed'
    if not Path('/dev/net/tun').exists():
        return 'the kernel has no TUN devices'
    name = f'try{os.getpid()}'
    if subprocess.run(['ip', 'netns', 'add', name], capture_output=True).returncode:
        return 'network namespaces are not allowed here'
    _ip('netns', 'del', name)
    return ''


class TwoHosts:
    """Two network namespaces joined by a link; use it as a context manager.

    Args:
        impairment: of the link.
        seed: seed of all random numbers.

    Attributes:
        names: of the namespaces.
        addresses: of the hosts in them.
    """

    addresses = ('10.77.0.1', '10.77.0.2')

    def __init__(self, impairment: Impairment | None = None, seed: int = 0) -> None:
        self.names = (f'arm{os.getpid()}', f'sim{os.getpid()}')
        self._impairment, self._seed = impairment or Impairment(), seed
        self._relay: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        for name in self.names:
            _ip('netns', 'add', name)
            _ip('-n', name, 'link', 'set', 'lo', 'up')
        given = json.dumps(asdict(self._impairment))
        self._relay = subprocess.Popen(
            [
                sys.executable,
                '-m',
                'bench.graph.impaired_link',
                given,
                str(self._seed),
                *self.names,
            ],
            cwd=Path(__file__).parents[2],
            stdout=subprocess.PIPE,
            stdin=subprocess.PIPE,
            text=True,
        )
        assert self._relay.stdout is not None
        if self._relay.stdout.readline() != 'up\n':
            self.__exit__()
            raise OSError('the link did not come up')
        return self

    def __exit__(self, *_: object) -> None:
        if self._relay is not None:
            self._relay.communicate()
        for name in self.names:
            subprocess.run(['ip', 'netns', 'del', name], check=False)

    def take_away(self, seconds: float) -> None:
        """Interrupt the link for some time [s]."""
        assert self._relay is not None and self._relay.stdin is not None
        self._relay.stdin.write(f'{seconds}\n')
        self._relay.stdin.flush()

    def on(self, host: int, command: Sequence[str]) -> list[str]:
        """Return a command as it is run on host 0 or 1."""
        return ['ip', 'netns', 'exec', self.names[host], *command]


def _ip(*words: str) -> None:
    subprocess.run(['ip', *words], check=True, capture_output=True)


def _tun(namespace: str, address: str) -> int:
    """Make the network device of a host; return its end in this process."""
    name = f't{namespace}'[:15]
    end = os.open('/dev/net/tun', os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(end, _TUNSETIFF, struct.pack('16sH22x', name.encode(), _IFF_TUN | _IFF_NO_PI))
    _ip('link', 'set', name, 'netns', namespace)
    _ip('-n', namespace, 'addr', 'add', f'{address}/24', 'dev', name)
    _ip('-n', namespace, 'link', 'set', name, 'mtu', str(MTU_BYTES), 'txqueuelen', '10000', 'up')
    _ip('-n', namespace, 'link', 'set', name, 'multicast', 'on')
    _ip('-n', namespace, 'route', 'add', '224.0.0.0/4', 'dev', name)
    return end


class _Direction:
    """Packets in transit from one end to the other."""

    def __init__(self, source: int, sink: int, impairment: Impairment, seed: int) -> None:
        self.source = source
        self._sink, self._is, self._random = sink, impairment, random.Random(seed)
        self._waiting: list[tuple[float, int, bytes]] = []
        self._count, self._newest, self._free = 0, 0.0, 0.0
        self.away_until = 0.0

    @property
    def due(self) -> float:
        """Return the delivery time of the next packet."""
        return self._waiting[0][0] if self._waiting else float('inf')

    def take(self) -> None:
        """Read the packets that have arrived."""
        while True:
            try:
                packet = os.read(self.source, 1 << 16)
            except BlockingIOError:
                return
            self._accept(packet, time.monotonic())

    def _accept(self, packet: bytes, now: float) -> None:
        link, draw = self._is, self._random.random
        lost, jitter, overtaken = draw() < link.loss, link.jitter * draw(), draw() < link.reorder
        if lost or now < self.away_until or len(self._waiting) >= _MAX_QUEUE:
            return
        self._free = max(self._free, now) + (len(packet) / link.rate if link.rate else 0.0)
        due = self._newest = max(self._newest, self._free + link.delay + jitter)
        if overtaken:
            due += REORDER_DELAY_S
        self._count += 1
        heapq.heappush(self._waiting, (due, self._count, packet))

    def hand_over(self, now: float) -> None:
        """Deliver the packets that are due."""
        while self._waiting and self._waiting[0][0] <= now:
            packet = heapq.heappop(self._waiting)[2]
            with contextlib.suppress(OSError):  # the other host does not take it: lost
                os.write(self._sink, packet)


def _relay(impairment: Impairment, seed: int, namespaces: Sequence[str]) -> None:
    """Carry packets until standard input is closed."""
    with contextlib.suppress(OSError):  # a network does not wait for a busy processor
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(30))
    a, b = (_tun(*host) for host in zip(namespaces, TwoHosts.addresses, strict=True))
    directions = (
        _Direction(a, b, impairment, 2 * seed),
        _Direction(b, a, impairment, 2 * seed + 1),
    )
    print('up', flush=True)
    while True:
        now = time.monotonic()
        wait_s = max(0.0, min(d.due for d in directions) - now)
        ready, _, _ = select.select([a, b, sys.stdin], [], [], min(wait_s, 0.1))
        if sys.stdin in ready:
            line = sys.stdin.readline()
            if not line:
                return
            for direction in directions:
                direction.away_until = time.monotonic() + float(line)
        for direction in directions:
            if direction.source in ready:
                direction.take()
            direction.hand_over(time.monotonic())


if __name__ == '__main__':
    _relay(Impairment(**json.loads(sys.argv[1])), int(sys.argv[2]), sys.argv[3:5])
