"""E-STOP in the launcher: its key, its state across restarts, and its delivery to the nodes.

The latch itself is in `node_common/operating_state.py`.
"""

import time
from collections.abc import Sequence
from dataclasses import replace

from cutting_trainer.session.node_process import NodeCommand
from cutting_trainer.session.terminal_keys import Keys

PRESS = 'e_stop'
"""Line on a node's standard input that presses E-STOP."""
PRESSED, RELEASED = 'e_stop: pressed', 'e_stop: released'
"""Lines by which a node reports the state of E-STOP."""
PRESSING_KEYS = frozenset('eE ')
"""Keys of the terminal that press E-STOP: e, and the space bar."""
REPEAT_PERIOD_S = 0.2
"""Period of the request [s] until a node confirms it."""


class EStopState:
    """Keep the state of E-STOP while its nodes die and restart.

    Args:
        commands: of the session; where none of them has an E-STOP, no key is read.
        keys: read the terminal's keys.

    Attributes:
        keys: keys of the terminal; a context manager.

    Each tool has a bridge with a latch of its own. A press is for all, and each is reset alone.
    """

    def __init__(self, commands: Sequence[NodeCommand], *, keys: bool = True) -> None:
        self._latches = {command.name for command in commands if command.e_stop_arguments}
        self.keys = Keys(active=keys and bool(self._latches))
        self._pressed: set[str] = set()
        self._owed: set[str] = set()
        self._next = 0.0

    @property
    def pressed(self) -> bool:
        """Last known state: whether it holds at a node, or is requested."""
        return bool(self._pressed or self._owed)

    @property
    def is_owed(self) -> bool:
        """Whether a node has not confirmed a request yet."""
        return bool(self._owed)

    def ask(self) -> None:
        """Press E-STOP. The request is repeated until every node confirms it."""
        self._owed |= self._latches
        self._next = 0.0

    def watch(self, commands: Sequence[NodeCommand]) -> None:
        """Forget the nodes that are no longer among those of the session."""
        self._latches = {command.name for command in commands if command.e_stop_arguments}
        self._pressed &= self._latches
        self._owed &= self._latches

    def poll(self) -> bool:
        """Read the keys; return whether the request must be sent to the nodes now."""
        if not PRESSING_KEYS.isdisjoint(self.keys.pressed()):
            self.ask()
        now = time.monotonic()
        if not self.is_owed or now < self._next:
            return False
        self._next = now + REPEAT_PERIOD_S
        return True

    def interpret(self, command: NodeCommand, line: str) -> bool:
        """Return whether a node's line is about E-STOP, and store the state that it reports."""
        if not command.e_stop_arguments or line not in (PRESSED, RELEASED):
            return False
        if line == PRESSED:
            self._owed.discard(command.name)
            self._pressed.add(command.name)
        else:  # of a node that is owed the request: it wrote this before it received that
            self._pressed.discard(command.name)
        return True

    def start_command(self, command: NodeCommand) -> NodeCommand:
        """Return the command with the arguments for the present state of E-STOP."""
        return (
            replace(command, argv=command.argv + command.e_stop_arguments)
            if command.name in self._pressed | self._owed
            else command
        )
