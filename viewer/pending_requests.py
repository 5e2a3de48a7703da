"""Queues between threads."""

import queue
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import TypeVar

from cutting_trainer.viewer.page_protocol import AnyMessage

Thing = TypeVar('Thing')


def taken(things: 'queue.SimpleQueue[Thing]') -> Iterator[Thing]:
    """Yield the items of a queue without blocking: another thread may take from it, too."""
    with suppress(queue.Empty):
        while True:
            yield things.get_nowait()


class Requests:
    """Pending requests of pages, the newest of each op, in the order of arrival.

    The ops are a closed list, so that it is never full, and a request is dropped only when a newer
    one of the same op replaces it. Threads may share it.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: dict[str, AnyMessage] = {}

    def put(self, message: AnyMessage) -> None:
        """Add a message; it replaces an older one of its op."""
        with self._lock:
            self._waiting.pop(message.op, None)
            self._waiting[message.op] = message

    def clear(self) -> None:
        """Remove all requests."""
        with self._lock:
            self._waiting.clear()

    def taken(self) -> Iterator[AnyMessage]:
        """Yield the requests one by one; those that are removed meanwhile are skipped."""
        while True:
            with self._lock:
                if not self._waiting:
                    return
                message = self._waiting.pop(next(iter(self._waiting)))
            yield message
