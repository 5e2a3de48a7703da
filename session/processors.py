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
from typing import Literal, NamedTuple

from cutting_trainer.node_common.timing import RECEIVES

Work = Literal['bridge', 'arm', 'messages', 'frames', 'other']
"""Work of a node: the force loop of a bridge or of an emulated arm, the messages of such loops, the
frames of the tissue, or what may run anywhere."""
LOOPS_PER_PROCESSOR = 2
"""Force loops that share a processor."""
_ADDRESS = '\0cutting_trainer.processors'


class Places(NamedTuple):
    """Processors by the work of a node; other work may run anywhere.

    Messages are written anywhere: on a slow machine two loops, and all of the recorder, are more
    than a processor can do, and messages were lost.

    Attributes:
        processes: of all threads.
        receivers: of those threads in which DDS receives, where they have others.
        remark: sentence about too few processors, or ''.
    """

    processes: dict[Work, set[int]]
    receivers: dict[Work, set[int]]
    remark: str = ''


ANYWHERE = Places({}, {})


def shared_out(work: Sequence[Work], processors: Sequence[int]) -> Places:
    """Return the processors by work; anywhere where they are too few.

    Frames get processors of their own. Where too few are left for all loops, the arms are on those
    of the frames, and the recorder receives anywhere: of two tools on two processors, 29 of 600
    frames are then missed (median of 9 sessions), and 98 where the kernel places the loops.

    Args:
        work: of each node.
        processors: those that may be used.
    """
    arms, bridges = work.count('arm'), work.count('bridge')
    apart, together = _processors_for(arms + bridges), _processors_for(bridges)
    count = apart if apart < len(processors) else together
    if 'frames' not in work or not count:
        return ANYWHERE
    remark = '' if apart < len(processors) else _too_few(arms + bridges, apart + 1, processors)
    if count >= len(processors):
        return ANYWHERE._replace(remark=remark)
    frames, loops = set(processors[:-count]), set(processors[-count:])
    crowded = count < apart
    if crowded and _processors_for(arms) > len(frames):
        return ANYWHERE._replace(remark=remark)
    return Places(
        {'frames': frames, 'bridge': loops, 'arm': frames if crowded else loops},
        {'frames': loops, 'arm': loops, 'messages': set(processors) if crowded else loops},
        remark,
    )


def _processors_for(loops: int) -> int:
    return -(-loops // LOOPS_PER_PROCESSOR)


def _too_few(loops: int, needed: int, processors: Sequence[int]) -> str:
    what, there = '1 force loop' if loops == 1 else f'{loops} force loops', len(processors)
    return (
        f'{what} and the tissue need {needed} processors, and this session has {there}: on slow '
        'ones frames come late, and messages may be lost. Take more processors, or fewer tools'
    )


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
def reserved_processors(work: Sequence[Work]) -> Iterator[Places]:
    """Share out the processors that this process may use, for one session of this machine.

    A second session would be put on the same ones: it gets none, and the kernel places its nodes.

    Args:
        work: of each node.
    """
    found = shared_out(work, sorted(os.sched_getaffinity(0)))
    with socket.socket(socket.AF_UNIX) as reservation:  # the kernel frees it with the process
        try:
            if found.processes:
                reservation.bind(_ADDRESS)
        except OSError:
            found = ANYWHERE._replace(remark=found.remark)
        yield found
