"""Table of the newest status of each node on /diagnostics."""

import math
import time
from typing import Any

from cutting_trainer.node_common.rejections import MessageError
from cutting_trainer.viewer.live_page import NodeState
from cutting_trainer.viewer.operator_commands import BRIDGE

_MAX_NODES, _MAX_TEXT = 32, 1000
"""Bounds for /diagnostics: foreign nodes in the table, characters of a text."""
_MAX_RATE_HZ, _LAST_LEVEL = 1e6, 3
_SILENT_S = 3.0
_MAX_SCALE = 100.0
OWN = frozenset(
    ('emulated_arm', 'haptic_bridge', 'tissue_sim', 'cutting', 'recorder', 'viewer', 'omni_adapter')
)
"""Nodes of a trainer: they are always in the table, whatever the number of others."""


class Statuses:
    """The newest status of each node. Its table is replaced, never changed: threads may share it.

    Args:
        namespace: of this trainer's nodes.
    """

    def __init__(self, namespace: str) -> None:
        self._namespace = namespace.strip('/')
        self._nodes: dict[str, tuple[float, NodeState]] = {}
        self._scale: float | None = None

    def take(self, message: Any) -> None:
        """Read a `diagnostic_msgs/msg/DiagnosticArray`.

        Raises:
            MessageError: a status in it has values of no node of ours, and was left out.
        """
        problem: MessageError | None = None
        for status in message.status:
            name = name_within(self._namespace, status.name)
            if not name:
                continue  # of another trainer beside this one
            try:
                self._take(name, status)
            except MessageError as error:
                problem = error
        if problem is not None:
            raise problem

    def _take(self, name: str, status: Any) -> None:
        others = sum(known not in OWN for known in self._nodes)
        admitted = name in OWN or name in self._nodes or others < _MAX_NODES
        if not admitted or max(len(name), len(status.message)) > _MAX_TEXT:
            raise MessageError('a status too many or too long')
        values = {pair.key: pair.value for pair in status.values}
        rate, level = _number(values.get('rate', '0')), status.level[0]
        if not 0 <= rate <= _MAX_RATE_HZ or level > _LAST_LEVEL:
            raise MessageError('no such rate or level', f'rate {rate:g}, level {level}')
        state = NodeState(name, level, status.message, rate)
        self._nodes = {**self._nodes, name: (time.monotonic(), state)}
        if name == BRIDGE and 'force_scale' in values:
            scale = _number(values['force_scale'])
            if not 0 < scale <= _MAX_SCALE:
                raise MessageError('no such force scale', f'{scale:g}')
            self._scale = scale

    def take_scale(self) -> float | None:
        """Return the force scale that the bridge has reported since the last call; None: none."""
        scale, self._scale = self._scale, None
        return scale

    def forget(self, *names: str) -> None:
        """Remove some nodes, or all."""
        kept = {name: received for name, received in self._nodes.items() if name not in names}
        self._nodes = kept if names else {}
        if BRIDGE not in self._nodes:
            self._scale = None

    def now(self, now: float) -> list[NodeState]:
        """Return a line for each node at a time [s], monotonic."""
        states = []
        for _, (received, state) in sorted(self._nodes.items()):
            if now - received > _SILENT_S:
                silent = f'silent for {now - received:.0f} s'
                state = state._replace(level=3, message=silent, rate=0.0)
            states.append(state)
        return states

    def said(self, name: str, now: float) -> str | None:
        """Return the newest message of a node; None where it is silent."""
        received, state = self._nodes.get(name, (-_SILENT_S, None))
        return None if state is None or now - received > _SILENT_S else state.message


def name_within(namespace: str, name: str) -> str:
    """Return a name on /diagnostics relative to a namespace ('': all); '' where it is not in it."""
    prefix = f'{namespace}/' if namespace else ''
    return name.removeprefix(prefix) if name.startswith(prefix) else ''


def _number(text: str) -> float:
    """Return the number in a status; NaN where it has none."""
    try:
        return float(text)
    except ValueError:
        return math.nan
