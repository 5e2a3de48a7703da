"""Flood a topic with words at a fixed rate, from a process of its own.

    python -m bench.flood TOPIC RATE

The process reads lines: `on` begins, `off` pauses. It answers `off` with the number of words sent
and the time that it took [s], once the reader has acknowledged them all. The end of its input ends
it.

Words are sent by a thread of the middleware, which packs many into a datagram: one datagram each
would end at about 3,500 words a second on two processors. The writer keeps every word until it is
acknowledged, so that each one counted has reached the reader.
"""

import os
import selectors
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

OFFERED_WORDS_PER_S = 20_000
"""Rate that leaves more than 10,000 words a second on two busy processors."""
BURST = 20
"""Words that are handed to the middleware at once."""
ACKNOWLEDGE_TIMEOUT_S = 5.0
"""Time in which the reader must acknowledge the last word."""


class Flood:
    """Flood the operating state's commands of a node; started paused.

    Attributes:
        acknowledged: words sent until the last pause, all of them acknowledged by the reader.
        seconds: [s] in which they were sent.
    """

    def __init__(self, topic: str, rate: int, environment: Mapping[str, str]) -> None:
        self.acknowledged, self.seconds = 0, 0.0
        self._process = subprocess.Popen(
            [sys.executable, '-m', __spec__.name, topic, str(rate)],
            cwd=Path(__file__).parents[1],
            env=dict(environment),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._answer() == 'ready'

    @property
    def rate(self) -> float:
        """Words per second while it was on."""
        return self.acknowledged / self.seconds if self.seconds else 0.0

    def begin(self) -> None:
        """Start to send."""
        self._send('on')

    def pause(self) -> None:
        """Stop to send, wait until all words are acknowledged, and count."""
        self._send('off')
        words, seconds = self._answer().split()
        self.acknowledged += int(words)
        self.seconds += float(seconds)

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(10.0)

    def _send(self, word: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f'{word}\n')
        self._process.stdin.flush()

    def _answer(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


def main(topic: str, rate: int) -> None:
    """Send words whenever the last line of the input was `on`."""
    os.environ['RMW_FASTRTPS_PUBLICATION_MODE'] = 'ASYNCHRONOUS'
    import rclpy
    from rclpy.qos import HistoryPolicy, QoSProfile
    from rclpy.serialization import serialize_message

    from cutting_trainer.node_common.operating_state import crtk_types

    rclpy.init()
    node, kind = rclpy.create_node('flood'), crtk_types().command
    publisher = node.create_publisher(kind, topic, QoSProfile(history=HistoryPolicy.KEEP_ALL))
    words = [serialize_message(kind(string=f'no {i}')) for i in range(BURST)]
    while not publisher.get_subscription_count():
        time.sleep(0.01)
    lines = selectors.DefaultSelector()
    lines.register(sys.stdin, selectors.EVENT_READ)
    # The reader knows the writer later than the writer the reader: before, words would be lost.
    publisher.publish(words[0])
    wait_for_all(publisher)
    print('ready', flush=True)
    is_on, sent, began, due = False, 0, 0.0, 0.0
    while True:
        if lines.select(max(due - time.monotonic(), 0.0) if is_on else None):
            line = os.read(0, 64).decode()
            if not line:
                break
            is_on = line.split()[-1] == 'on'
            if is_on:
                sent, began = 0, time.monotonic()
                due = began
            else:
                seconds = time.monotonic() - began
                wait_for_all(publisher)
                print(sent, seconds, flush=True)
        if is_on and time.monotonic() >= due:
            for word in words:
                publisher.publish(word)
            sent += BURST
            due += BURST / rate
    node.destroy_node()
    rclpy.shutdown()


def wait_for_all(publisher: Any) -> None:
    """Wait until the reader has acknowledged every word."""
    from rclpy.duration import Duration

    if not publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGE_TIMEOUT_S)):
        raise TimeoutError('the reader does not acknowledge the words')


if __name__ == '__main__':
    main(sys.argv[1], int(sys.argv[2]))
