"""E-STOP in the launcher: its key, its state across restarts, and its delivery to nodes."""

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
        pressed: last known state.
        keys: keys of the terminal; a context manager.
        is_owed: pressed, but no node has confirmed it yet.
    """

    def __init__(self, commands: Sequence[NodeCommand], *, keys: bool = True) -> None:
        self.pressed = False
        self.keys = Keys(active=keys and any(command.e_stop_arguments for command in commands))
        self.is_owed = False
        self._next = 0.0

    def ask(self) -> None:
        """Press E-STOP. The request is repeated until a node confirms it."""
        self.pressed = self.is_owed = True
        self._next = 0.0

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
        self.is_owed &= line == RELEASED  # the node wrote it before it received the request
        self.pressed = line == PRESSED or self.is_owed
        return True

    def start_command(self, command: NodeCommand) -> NodeCommand:
        """Return the command with the arguments for the present state of E-STOP."""
        return (
            replace(command, argv=command.argv + command.e_stop_arguments)
            if self.pressed
            else command
        )
