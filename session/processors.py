"""Processors of a session: force loops on some, the frames of the tissue on the others.

A loop of 1 kHz that wakes on the processor of a frame stops it, even while another processor has
nothing to do. On two processors frames then took half as long again (docs/architecture.md).
"""

import os
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Literal

Work = Literal['force loop', 'frames', 'other']
"""Work of a node: a loop of 1 kHz, the frames of the tissue, or what may run anywhere."""
LOOPS_PER_PROCESSOR = 2
"""Force loops that share a processor: those of an arm and its bridge."""
_ADDRESS = '\0cutting_trainer.processors'


def shared_out(work: Sequence[Work], processors: Sequence[int]) -> dict[Work, set[int]]:
    """Return the processors by the work that is done on them alone; {} where they are too few.

    Args:
        work: of each node.
        processors: those that may be used.
    """
    count = -(-work.count('force loop') // LOOPS_PER_PROCESSOR)
    if 'frames' not in work or not 0 < count < len(processors):
        return {}
    return {'frames': set(processors[:-count]), 'force loop': set(processors[-count:])}


@contextmanager
def reserved_processors(work: Sequence[Work]) -> Iterator[dict[Work, set[int]]]:
    """Share out the processors that this process may use, for one session of this machine.

    A second session would be put on the same ones: it gets none, and the kernel places its nodes.

    Args:
        work: of each node.
    """
    found = shared_out(work, sorted(os.sched_getaffinity(0)))
    with socket.socket(socket.AF_UNIX) as reservation:  # the kernel frees it with the process
        try:
            if found:
                reservation.bind(_ADDRESS)
        except OSError:
            found = {}
        yield found
