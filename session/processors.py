"""Processors of a session: force loops on some, the frames of the tissue on the others.

What wakes at 1 kHz on the processor of a frame stops it, even while another processor has nothing
to do: a loop, and a thread that receives the messages of one. On two processors frames then took
half as long again (docs/architecture.md). A loop also sends in less time to a thread of its own
processor than to one that sleeps on another.
"""

import os
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

from cutting_trainer.node_common.timing import RECEIVES

Work = Literal['force loop', 'messages', 'frames', 'other']
"""Work of a node: a loop of 1 kHz, the messages of such loops, the frames of the tissue, or what
may run anywhere."""
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
    loops = set(processors[-count:])
    return {'frames': set(processors[:-count]), 'force loop': loops, 'messages': loops}


def place(pid: int, processors: set[int]) -> None:
    """Put a process that has only just started on some processors."""
    with suppress(ProcessLookupError):  # it has just ended
        os.sched_setaffinity(pid, processors)


def place_receivers(pid: int, processors: set[int]) -> None:
    """Put those threads of a process on some processors in which DDS receives."""
    for thread in Path(f'/proc/{pid}/task').glob('*'):
        with suppress(OSError):  # it has just ended
            if (thread / 'comm').read_text().startswith(RECEIVES):
                os.sched_setaffinity(int(thread.name), processors)


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
