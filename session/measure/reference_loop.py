"""A loop that does nothing but wake up: what this machine gives a Python process at 1 kHz.

Run as `python -m session.measure.reference_loop SECONDS`, where cyclictest is not installed; prints
JSON.
"""

import json
import sys

from haptic_bridge.realtime import prepare
from tissue_sim.timing import PeriodicLoop

RATE = 1000.0


def main(seconds: float) -> None:
    """Sleeps to deadlines for some seconds and prints how late it woke."""
    ticks = round(seconds * RATE)
    loop = PeriodicLoop(RATE, window=ticks)
    real_time = prepare()
    loop.start()
    while loop.ticks + loop.missed < ticks:
        loop.wait()
    print(json.dumps(loop.report() | {'real_time': real_time}), flush=True)


if __name__ == '__main__':
    main(float(sys.argv[1]))
