"""Outcome of the processes of a session."""

import signal
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Death:
    """Unexpected end of a node.

    Attributes:
        node: name of the node.
        returncode: exit status, or the negative number of the signal.
        elapsed: time since every node was ready [s]; None before that.
        tail: last lines of its output.
        hung: time without a heartbeat after which it was killed [s]; 0: it was not killed.
    """

    node: str
    returncode: int
    elapsed: float | None
    tail: tuple[str, ...]
    hung: float = 0.0

    @property
    def sentence(self) -> str:
        """Node, cause and time of the death."""
        when = 'before it was ready' if self.elapsed is None else f'after {self.elapsed:.1f} s'
        if self.hung:
            return f'{self.node} hung {when}: killed, no sign of life for {self.hung:g} s'
        return f'{self.node} died {when} ({describe(self.returncode)})'


@dataclass
class Outcome:
    """Outcome of the processes of a session.

    Attributes:
        ran: every node was ready.
        finished: the node that ends the session wrote `done: NAME`.
        interrupted: the user or the system asked for the end.
        seconds: time from the last node being ready to the end [s].
        deaths: deaths of nodes, in order.
        unready: sentence about the nodes that were not ready in time.
        killed: nodes that did not end within their grace period.
        failures: sentences of the lines `failed: NAME: sentence`.
    """

    ran: bool = False
    finished: bool = False
    interrupted: bool = False
    seconds: float = 0.0
    deaths: list[Death] = field(default_factory=list)
    unready: str = ''
    killed: list[str] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)

    @property
    def kills(self) -> list[str]:
        """`killed`, as sentences."""
        return [f'{name} had to be killed at the end' for name in self.killed]

    @property
    def troubles(self) -> list[str]:
        """Deaths, kills and failures, as sentences."""
        return [*(death.sentence for death in self.deaths), *self.kills, *self.failures]


def describe(returncode: int) -> str:
    """Return the signal or the exit status of a process in words."""
    if returncode < 0:
        return f'killed by {signal.Signals(-returncode).name}'
    return f'exit status {returncode}'
