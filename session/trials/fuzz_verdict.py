"""What became of nodes that were sent what nobody should send. Every "no" is a sentence."""

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

MOST_LINES = 20
"""Lines that a node may write into its log in a second."""
GROWTH = 1.5
"""Memory afterwards over memory before."""
ALLOWANCE = 150.0
"""[MB] that a node may have beside that; and the largest message for each topic that it hears:
Fast DDS keeps a buffer as large as the largest one that a reader has had."""
SILENCE = 30.0
"""[s] without a word on /diagnostics after which a node hangs; less may be one that gets no turn:
fuzzer and force loops want two processors for themselves."""
STANDSTILL = 2.0
"""[s] between two periods of a node's loop after which it has stood still."""
_STAMPED = re.compile(r'\[(\d+)\.\d+\]|^\d{4}-\d\d-\d\d (\d\d:\d\d:\d\d)')
"""Of a node's lines, and of those of DDS."""
_REFUSED = 'refused '


@dataclass
class Node:
    """What was seen of one node.

    Attributes:
        before, after, most: resident memory [MB]: before the first bad message, at the end, ever.
        hears: topics that it is subscribed to.
        spoke: when it spoke on /diagnostics last, by its own stamp [s]; None: never.
        silence: longest time between two times [s].
        period: longest of its loop, by its own word [s]; 0 where it has none.
        values: of its newest status.
        busiest: most lines of its log in one second.
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
        """Messages that it has refused, by topic and reason."""
        found = {k: v for k, v in self.values.items() if k.startswith(_REFUSED)}
        return {key.removeprefix(_REFUSED): int(value) for key, value in found.items()}

    def speaks(self, now: float, values: Mapping[str, str]) -> None:
        """Takes note of a status at a time [s]."""
        if self.spoke is not None:
            self.silence = max(self.silence, now - self.spoke)
        self.spoke, self.values = now, values
        self.period = max(self.period, float(values.get('period_max', 0.0)))


def problems(name: str, node: Node, now: float, largest: float) -> list[str]:
    """What is not as it should be of a node.

    Args:
        name: of it.
        node: as it was seen.
        now: end of the session [s].
        largest: of the messages that were sent [MB].
    """
    found = []
    allowed = GROWTH * node.before + ALLOWANCE + largest * node.hears
    if node.after > allowed:
        found.append(
            f'{name} has {node.after:.0f} MB at the end, {node.before:.0f} before: '
            f'{allowed:.0f} are allowed'
        )
    if node.spoke is None or max(now - node.spoke, node.silence) > SILENCE:
        silence = node.silence if node.spoke is None else max(now - node.spoke, node.silence)
        found.append(f'{name} said nothing on /diagnostics for {silence:.1f} s')
    if node.period > STANDSTILL:
        found.append(f'the loop of {name} stood still for {node.period:.1f} s')
    if not node.refused:
        found.append(f'{name} has counted nothing that it refused')
    if node.busiest > MOST_LINES:
        found.append(
            f'{name} wrote {node.busiest} lines into its log in one second: '
            f'{MOST_LINES} are allowed'
        )
    return found


def busiest_second(log: str) -> int:
    """Most lines of a log with the same second in their stamps."""
    stamps = (_STAMPED.search(line[:60]) for line in log.splitlines())
    return max(Counter(s[1] or s[2] for s in stamps if s is not None).values(), default=0)
