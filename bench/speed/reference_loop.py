"""Reference loop that only wakes up: lateness of a Python process at 1 kHz on this machine.

Run as `python -m bench.speed.reference_loop SECONDS`, where cyclictest is not installed; prints
JSON.
"""

import json
import sys

from cutting_trainer.node_common.realtime import prepare
from cutting_trainer.node_common.timing import PeriodicLoop

RATE_HZ = 1000.0


def main(seconds: float) -> None:
    """Sleep to deadlines for some seconds and print the lateness."""
    ticks = round(seconds * RATE_HZ)
    loop = PeriodicLoop(RATE_HZ, window=ticks)
    real_time = prepare()
    loop.start()
    while loop.ticks + loop.missed < ticks:
        loop.wait()
    print(json.dumps(loop.report() | {'real_time': real_time}), flush=True)


if __name__ == '__main__':
    main(float(sys.argv[1]))
