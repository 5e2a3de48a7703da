"""Checks of the nodes of a fuzzed session; each failure is a sentence."""

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

MAX_LINES_PER_SECOND = 20
"""Number of lines that a node may log in a second."""
MAX_MEMORY_GROWTH = 1.5
"""Largest ratio of the memory after to the memory before."""
MEMORY_ALLOWANCE_MB = 150.0
"""Additional memory of a node [MB], beside the largest message for each subscribed topic: Fast DDS
keeps a buffer as large as the largest message of a reader."""
MAX_SILENCE_S = 30.0
"""A node without a status on /diagnostics for this long hangs. A shorter time may be a lack of
processor time: fuzzer and force loops need two processors."""
MAX_LOOP_PERIOD_S = 2.0
"""A longer period of a node's loop is a standstill."""
_STAMPED = re.compile(r'\[(\d+)\.\d+\]|^\d{4}-\d\d-\d\d (\d\d:\d\d:\d\d)')
"""Stamp of a node's log line, and of a line of DDS."""
_REFUSED = 'refused '


@dataclass
class Node:
    """Observations of one node.

    Attributes:
        before, after, most: resident memory [MB]: before the first bad message, at the end, ever.
        hears: number of its subscribed topics.
        spoke: stamp of its last status on /diagnostics [s]; None: none yet.
        silence: longest time between two statuses [s].
        period: longest period of its loop, by its report [s]; 0 where it has none.
        values: values of its newest status.
        busiest: largest number of its log lines in one second.
    """

    before: float = 0.0
    after: float = 0.0
    most: float = 0.0
    hears: int = 0
    spoke: float | None = None
    silence: float = 0.0
    period: float = 0.0
    values: Mapping[str, str] = field(default_factory=dict)
    busiest: int = 0

    @property
    def refused(self) -> dict[str, int]:
        """Rejected messages, by topic and reason."""
        found = {k: v for k, v in self.values.items() if k.startswith(_REFUSED)}
        return {key.removeprefix(_REFUSED): int(value) for key, value in found.items()}

    def speaks(self, now: float, values: Mapping[str, str]) -> None:
        """Register a status at a time [s]."""
        if self.spoke is not None:
            self.silence = max(self.silence, now - self.spoke)
        self.spoke, self.values = now, values
        self.period = max(self.period, float(values.get('period_max', 0.0)))


def problems(name: str, node: Node, now: float, largest: float) -> list[str]:
    """Return failures of a node.

    Args:
        name: name of the node.
        node: observations of the node.
        now: end of the session [s].
        largest: size of the largest sent message [MB].
    """
    found = []
    allowed = MAX_MEMORY_GROWTH * node.before + MEMORY_ALLOWANCE_MB + largest * node.hears
    if node.after > allowed:
        found.append(
            f'{name} has {node.after:.0f} MB at the end, {node.before:.0f} before: '
            f'{allowed:.0f} are allowed'
        )
    if node.spoke is None or max(now - node.spoke, node.silence) > MAX_SILENCE_S:
        silence = node.silence if node.spoke is None else max(now - node.spoke, node.silence)
        found.append(f'{name} said nothing on /diagnostics for {silence:.1f} s')
    if node.period > MAX_LOOP_PERIOD_S:
        found.append(f'the loop of {name} stood still for {node.period:.1f} s')
    if not node.refused:
        found.append(f'{name} has counted nothing that it refused')
    if node.busiest > MAX_LINES_PER_SECOND:
        found.append(
            f'{name} wrote {node.busiest} lines into its log in one second: '
            f'{MAX_LINES_PER_SECOND} are allowed'
        )
    return found


def busiest_second(log: str) -> int:
    """Return the largest number of lines of a log with the same second in their stamps."""
    stamps = (_STAMPED.search(line[:60]) for line in log.splitlines())
    return max(Counter(s[1] or s[2] for s in stamps if s is not None).values(), default=0)
