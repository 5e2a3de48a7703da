"""Watches how long each processor gives no turn.

Every stand-still is a line: when it ended and how long it was, [s] of the monotonic clock.

A virtual machine may lose a processor for tens of milliseconds, and a deadline of 30 ms with it.
"""

import os
import threading
import time

PERIOD = 0.002
NOTED = 0.015


def watch(processor: int) -> None:
    """Prints the stand-stills of a processor."""
    os.sched_setaffinity(0, {processor})
    last = time.monotonic()
    while True:
        time.sleep(PERIOD)
        now = time.monotonic()
        if now - last > PERIOD + NOTED:
            os.write(1, f'{now} {now - last}\n'.encode())  # whole, whoever else writes
        last = now


if __name__ == '__main__':
    for processor in os.sched_getaffinity(0):
        threading.Thread(target=watch, args=(processor,), daemon=True).start()
    threading.Event().wait()
