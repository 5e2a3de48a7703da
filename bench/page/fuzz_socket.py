"""Raw messages to a page's server by its protocol: valid, nearly valid, and invalid.

Run `python -m bench.page.fuzz_socket [--messages 100000]`: fuzzes a server with stand-in actions,
then tries every control on other pages, and prints the leaks.
"""

import argparse
import json
import random
import select
import socket
import statistics
import struct
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, suppress
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from websockets.frames import Frame, Opcode

from bench.common.waiting import until
from bench.page.open_page import STEP_TIMEOUT_S, OpenPage, session_address
from bench.page.stand_in import VALID, OtherProcess

_NUMBERS = ('NaN', 'Infinity', '-Infinity', '1e400', '-1e308', '9' * 400, '1e-400', '-0', '0x10')
_WORDS: tuple[Any, ...] = (
    None, True, False, '', 'x' * 1500, '../../../../etc/passwd', '/etc/passwd', 'liver\n', '\0',
    [], {}, [[]], {'__proto__': {}}, -1, 0, 3.5, 2**63, 2**70, 1e308, 'e_stop', [1, 2, 3],
    {'$ref': '#'}, '\ud800', '{{7*7}}', '$(id)', 'message: {"ask": "restart"}',
)  # fmt: skip
_AT_ONCE, _BAD_SHARE = 10, 0.1
"""Number of messages sent together, and share of these whose last one ends the page."""
_VISER = (
    b'\x82\xa4type\xb0GuiUpdateMessage\xa7updates\x81\xa9update_cb\x90',
    b'\x81\xa4type\xb0ShareUrlRequest',
    b'\x84\xa4type\xb7FileTransferStartUpload\xa4uuid\xa1x\xaasize_bytes\xce\x2f\xaf\x08\x00',
)
"""Messages that broke the page of a former server, viser."""


def text(random_: random.Random) -> str:
    """Return one text: a valid message, one with an error, or no message."""
    op = random_.choice([*VALID, 'ping', 'play', 'seek', 'speed', 'share', 'upload', '__class__'])
    fields = dict(VALID.get(op, {'id': 1} if op == 'ping' else {}))
    message: dict[str, Any] = {'op': op, **fields}
    kind = random_.randrange(9)
    if kind == 1 and fields:
        message[random_.choice(list(fields))] = random_.choice(_WORDS)
    elif kind == 2:
        message[random_.choice(['update_cb', 'removed', 'disabled', '__init__'])] = []
    elif kind == 3:
        message.pop(random_.choice(list(message)))
    elif kind == 4:
        number = random_.choice(_NUMBERS)
        where = random_.choice(['"value"', '"position"', '"id"', '"on"'])
        return f'{{"op": "{op}", {where}: {number}}}'
    elif kind == 5:
        depth = random_.randrange(1000)
        return random_.choice(['[' * depth, '{"op":' * (depth // 6), '[' * depth + ']' * depth])
    elif kind == 6:
        message['op'] = random_.choice(_WORDS)
    elif kind == 7:
        return ''.join(chr(random_.randrange(1, 0xD7FF)) for _ in range(random_.randrange(40)))
    return json.dumps(message)


class SentCounts(NamedTuple):
    """Counts of sent messages.

    Attributes:
        messages: raw ones.
        openings: of pages, since many of them end theirs.
    """

    messages: int
    openings: int


class RawPage:
    """Raw socket of a page's server: it sends bytes as they are.

    Args:
        url: of the page.
    """

    def __init__(self, url: str) -> None:
        parts = urlsplit(session_address(url))
        assert parts.hostname is not None
        self._socket = socket.create_connection((parts.hostname, parts.port or 80), STEP_TIMEOUT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.sendall(
            f'GET {parts.path}?{parts.query} HTTP/1.1\r\nHost: {parts.netloc}\r\n'
            'Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n'
            'Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n'.encode()
        )
        self.answer = self._socket.recv(4096)

    def send(self, data: bytes) -> None:
        """Send bytes, and read the received ones: this page reads its answers."""
        self._socket.sendall(data)
        while select.select([self._socket], [], [], 0.0)[0] and self._socket.recv(1 << 20):
            pass

    def close(self) -> None:
        """Close once the server has read everything."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)
            while self._socket.recv(1 << 20):
                pass
        self._socket.close()


def frame(data: str | bytes, opcode: Opcode = Opcode.TEXT, *, last: bool = True) -> bytes:
    """Return a message, or a piece of one, as a page sends it."""
    raw = data.encode(errors='surrogatepass') if isinstance(data, str) else data
    return Frame(opcode, raw, fin=last).serialize(mask=True)


def bad_frames(random_: random.Random) -> bytes:
    """Return bytes that no valid page sends."""
    kind = random_.randrange(8)
    if kind == 0:
        return frame(random_.choice(_VISER), Opcode.BINARY)
    if kind == 1:
        return frame(random_.randbytes(random_.randrange(2000)), Opcode.BINARY)
    if kind == 2:
        return frame('x' * random_.choice([2049, 5000, 100_000]))
    if kind == 3:  # a fragment a letter: this one is a message
        letters = json.dumps({'op': 'start'})
        first, *others = (frame(letter, last=False) for letter in letters)
        others = [frame(letter, Opcode.CONT, last=False) for letter in letters[1:]]
        return b''.join([first, *others, frame('', Opcode.CONT)])
    if kind == 4:
        return frame(b'\xff\xfe\xfd')  # no UTF-8
    if kind == 5:  # the promise of a huge one
        return b'\x81\xff' + struct.pack('>Q', 2**62) + bytes(4)
    if kind == 6:
        return random_.randbytes(64)
    return frame(b'', Opcode.PING) * 100 + frame(b'x', Opcode.CONT)


class _Fuzzer:
    def __init__(self, url: str, seed: int) -> None:
        self._url, self._random = url, random.Random(seed)
        self._page: RawPage | None = None
        self.openings = 0

    def send(self, count: int) -> None:
        """Send raw messages, on a page that is opened again after each end."""
        if self._page is None:
            self._page = RawPage(self._url)
            self.openings += 1
        bad = self._random.random() < _BAD_SHARE
        frames = [frame(text(self._random)) for _ in range(count - bad)]
        if bad:
            frames.append(bad_frames(self._random))
        try:
            self._page.send(b''.join(frames))
        except OSError:
            bad = True
        if bad:
            self.close()

    def close(self) -> None:
        if self._page is not None:
            self._page.close()
            self._page = None


def fuzz(url: str, messages: int, seed: int, pages: int = 3) -> SentCounts:
    """Send raw messages by some pages in turn.

    Args:
        url: of the page.
        messages: how many.
        seed: of all that is random.
        pages: that send.
    """
    fuzzers = [_Fuzzer(url, seed + number) for number in range(pages)]
    for number in range(messages // _AT_ONCE):
        fuzzers[number % pages].send(_AT_ONCE)
    for fuzzer in fuzzers:
        fuzzer.close()
    return SentCounts(messages // _AT_ONCE * _AT_ONCE, sum(fuzzer.openings for fuzzer in fuzzers))


class Outcome(NamedTuple):
    """State of the server after a fuzz.

    Attributes:
        messages: that were sent.
        openings: of pages by which they were sent.
        acted: requests that the server carried out of them.
        tried: controls that were tried on other pages.
        working: those of them that worked.
        memory: by which that of the server grew [MB].
        processes: that the server has started.
        connections: that it has made.
        threads: by which its threads grew.
    """

    messages: int
    openings: int
    acted: int
    tried: int
    working: int
    memory: float
    processes: int
    connections: int
    threads: int


def trial(messages: int, seed: int, *, limited: bool) -> Outcome:
    """Fuzz a server with stand-in actions while two more pages are open, then use those.

    Args:
        messages: how many.
        seed: of all that is random.
        limited: with the limits of a real page: most of the messages are then dropped; else each
            reaches the protocol.
    """
    with OtherProcess(limited=limited) as server, ExitStack() as stack:
        pages = [OpenPage(server.url) for _ in range(2)]
        for page in pages:
            stack.callback(page.close)
        tally = fuzz(server.url, min(messages // 10, 1000), seed)
        before = server.memory, server.report()['threads']
        tally = fuzz(server.url, messages, seed + 100)
        acted = sum(server.report()['asked'].values())
        working = sum(works(server, page, op) for page in pages for op in VALID)
        after = server.report()
        return Outcome(
            messages=tally.messages,
            openings=tally.openings,
            acted=acted,
            tried=len(pages) * len(VALID),
            working=working,
            memory=server.memory - before[0],
            processes=server.children,
            connections=server.connections,
            threads=after['threads'] - before[1],
        )


def works(server: OtherProcess, page: OpenPage, op: str) -> bool:
    """Return whether a control of a page works once."""
    count = server.report()['asked'].get(op, 0)
    page.ask(op, **VALID[op])
    with suppress(AssertionError):
        until(lambda: server.report()['asked'].get(op, 0) > count, op, 5.0)
    return bool(server.report()['asked'].get(op, 0) == count + 1)


def stop_delays(server: OtherProcess, page: OpenPage, clicks: int, pause: float) -> list[float]:
    """Return the time from each E-STOP of a page to its action [s]."""
    delays = []
    for _ in range(clicks):
        known = server.report()['stopped']
        last = known[-1] if known else 0.0
        time.sleep(pause)
        clicked = time.perf_counter()
        page.ask('e_stop')
        heard = until(lambda last=last: newer(server, last), 'the E-STOP')
        delays.append(heard - clicked)
    return delays


def newer(server: OtherProcess, last: float) -> float:
    """Return the time of the first E-STOP after one [s]; 0 where there is none."""
    return next((at for at in server.report()['stopped'] if at > last), 0.0)


class Flood:
    """Pages that send as much as they can, in a process of their own; a context manager.

    Args:
        url: of the page.
        pages: how many; 0: none.
    """

    def __init__(self, url: str, pages: int) -> None:
        command = [sys.executable, '-m', __spec__.name, '--flood', url, '--pages', str(pages)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self._process.stdout.readline()

    def __enter__(self) -> 'Flood':
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()


def flood(url: str) -> None:
    """Send without pause, on a page that is opened again after each end."""
    frames = frame(json.dumps({'op': 'guide', **VALID['guide']})) * 200
    while True:
        with suppress(OSError):
            page = RawPage(url)
            try:
                while True:
                    page.send(frames)
            finally:
                page.close()


def main() -> None:
    """Fuzz, and print the state of the server."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--messages', type=int, default=100_000)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--limited', action='store_true', help='with the limits of a real page')
    parser.add_argument('--flood', metavar='URL', default='', help='do nothing but flood this page')
    parser.add_argument('--pages', type=int, default=3, help='that flood')
    given = parser.parse_args()
    if given.flood:
        for _ in range(given.pages):
            threading.Thread(target=flood, args=(given.flood,)).start()
        print('floods', flush=True)
        threading.Event().wait()
    began = time.monotonic()
    print(trial(given.messages, given.seed, limited=given.limited))
    print(f'{time.monotonic() - began:.1f} s')
    with OtherProcess(limited=True) as server:
        page = OpenPage(server.url)
        for floods in (0, 3):
            with Flood(server.url, floods):
                delays = sorted(1e3 * d for d in stop_delays(server, page, 100, 0.01))
            median = statistics.median(delays)
            print(f'{floods} pages flood: E-STOP after {median:.2f} ms, worst {delays[-1]:.2f} ms')
        page.close()


if __name__ == '__main__':
    main()
