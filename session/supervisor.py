"""Start, supervise and end the nodes of a session; nothing is left running."""

import selectors
import signal
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from cutting_trainer.node_common.timing import preferred_group
from cutting_trainer.session.e_stop_memory import PRESS, PRESSED, EStopState
from cutting_trainer.session.node_process import (
    NodeCommand,
    NodeProcess,
    is_warning,
    parse_message,
    unready_sentence,
)
from cutting_trainer.session.outcome import Death, Outcome, describe
from cutting_trainer.session.processors import (
    ANYWHERE,
    place,
    place_receivers,
    reserved_processors,
)
from cutting_trainer.session.restart_backoff import Backoff

STOPPING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
POLL_PERIOD_S = 0.05  # [s]
MAX_SHOWN_WARNINGS = 20
START_TIMEOUT_S = 180.0
"""A busy machine, or kernels that are not compiled yet, may take minutes; a node that dies is
reported at once."""
SLOW_NODE_TIMEOUT_S = 60.0
"""Heartbeat timeout of the recorder and of the viewer. A disk may block for long, and a kill loses
the end of the bag; the viewer has the lowest priority."""
HEARTBEAT_TIMEOUT_S = 10.0
"""A ready node without a heartbeat for this long is killed. A busy machine may not run a node for
seconds, and the force is zero 0.15 s after the last frame anyway."""
MAX_POLL_GAP_S = 0.5
"""Longest time between two polls that counts; during the rest the supervisor itself did not run."""
HURRIED_GRACE_S = 1.0
"""Grace period of the nodes [s] after a second interrupt."""
EXPECTED_STATUSES = (0, -signal.SIGINT, -signal.SIGTERM, -signal.SIGALRM)
"""SIGALRM ends a node whose work is done, and whose middleware hangs; see `lifecycle`."""


@dataclass(frozen=True)
class Event:
    """Event of the supervisor; `text` is a sentence or a line of the node.

    Attributes:
        content: content of a message.
    """

    kind: Literal['ready', 'phase', 'message', 'warning', 'died', 'ending', 'killed']
    node: str
    text: str
    content: Mapping[str, Any] = field(default_factory=dict)


class Supervisor:
    """Run a set of nodes to the end of a session; a context manager.

    All work is done in the calling thread, which must be the main one: the kernel ties the life
    of the processes to it. SIGINT, SIGTERM and SIGHUP end the session in order. A second signal
    kills the nodes that do not end within a second, except nodes that record. Each node has its own
    process group, so that a terminal's Ctrl-C reaches the supervisor alone.

    Args:
        commands: nodes in the order of their end, those that record last.
        log_folder: folder of the logs, one file a node; made as soon as its parent exists.
        environment: environment of every node.
        on_event: called with each event.
        restart: restart nodes that die, with `NodeCommand.restart_arguments`.
        heartbeat_timeout: a node without a heartbeat for this long is killed [s].
    """

    def __init__(
        self,
        commands: Sequence[NodeCommand],
        log_folder: Path,
        environment: Mapping[str, str],
        on_event: Callable[[Event], None] = lambda event: None,
        *,
        restart: bool = False,
        heartbeat_timeout: float = HEARTBEAT_TIMEOUT_S,
        keys: bool = True,
    ) -> None:
        self.outcome = Outcome()
        self.e_stop = EStopState(commands, keys=keys)
        self._commands = commands
        self._logs = log_folder
        self._held = ExitStack()
        self._places = ANYWHERE
        self._environment = environment
        self._emit = on_event
        self._nodes: dict[str, NodeProcess] = {}
        self._selector = selectors.DefaultSelector()
        self._interrupts = 0
        self._began: float | None = None
        self._heartbeat_timeout = heartbeat_timeout
        self._looked, self._lived = time.monotonic(), 0.0
        self._handlers: dict[int, object] = {}
        self._backoffs: defaultdict[str, Backoff] | None = defaultdict(Backoff) if restart else None

    def __enter__(self) -> 'Supervisor':
        for number in STOPPING_SIGNALS:
            self._handlers[number] = signal.signal(number, self._on_signal)
        self.e_stop.keys.__enter__()
        self._held.enter_context(preferred_group())
        work = [command.work for command in self._commands]
        self._places = self._held.enter_context(reserved_processors(work))
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.end()
        finally:
            self._held.close()
            self.e_stop.keys.__exit__(None, None, None)
            for number, handler in self._handlers.items():
                signal.signal(number, handler)  # type: ignore[arg-type]

    @property
    def pids(self) -> dict[str, int]:
        """Process ids of the nodes that live, by name."""
        return {name: node.process.pid for name, node in self._nodes.items() if node.alive}

    def start(self, timeout: float = START_TIMEOUT_S) -> bool:
        """Start the nodes that record, wait for them, and then start the others.

        Args:
            timeout: time in which all must be ready [s].

        Returns:
                Whether all are ready; if not, the outcome has the reason.
        """
        if self._places.remark:
            self._emit(Event('warning', 'session', self._places.remark))
        if not self._start_all(self._commands, timeout):
            return False
        self._began = time.monotonic()
        self.outcome.ran = True
        return True

    def replace(self, commands: Sequence[NodeCommand], timeout: float = START_TIMEOUT_S) -> bool:
        """Replace nodes: end those with the same names, then start these.

        Args:
            commands: commands to run from now on.
            timeout: time in which all must be ready [s].

        Returns:
                Whether all are ready; if not, the outcome has the reason: call `remove` then.
        """
        self.remove([command.name for command in commands])
        self.outcome.unready = ''
        self._commands = [*self._commands, *commands]
        self.e_stop.watch(self._commands)
        return self._start_all(commands, timeout)

    def remove(self, names: Collection[str]) -> None:
        """End some nodes; those that record after the others."""
        for records in (False, True):
            nodes = [node for name, node in self._nodes.items() if name in names]
            self._end([node for node in nodes if node.command.records == records], 0)
        self._poll(0.0)
        self._commands = [command for command in self._commands if command.name not in names]
        for name in names:
            if self._backoffs is not None:
                self._backoffs.pop(name, None)  # a node that was asked to end is not restarted
            if (node := self._nodes.pop(name, None)) is not None:
                self._close(node)

    def signal(self, name: str, number: signal.Signals) -> None:
        """Send a signal to a running node; if it dies of it, that counts as any death."""
        if name in self.pids:
            self._nodes[name].send(number)

    def answer(self, name: str, text: str) -> None:
        """Write a line to a node that converses."""
        if name in self.pids:
            self._nodes[name].answer(text)

    def _start_all(self, commands: Sequence[NodeCommand], timeout: float) -> bool:
        deadline = time.monotonic() + timeout
        deaths = len(self.outcome.deaths)
        for records in (True, False):
            for command in commands:
                if command.records == records:
                    if self._interrupts:
                        return False
                    self._start(command)
            if not self._wait_ready(deadline, timeout, deaths):
                return False
        return True

    def run(
        self,
        seconds: float,
        *,
        until_done: Collection[str] = (),
        tick: Callable[[float], object] = lambda elapsed: None,
    ) -> None:
        """Supervise the session until its end; after a death the other nodes go on.

        Args:
            seconds: longest duration [s].
            until_done: nodes whose lines `done: NAME` end the session, once all of them that live
                have written it.
            tick: called often with the elapsed time [s]; the session ends when it returns False.
        """
        assert self._began is not None, 'start() first'
        elapsed = 0.0
        while not self._interrupts and elapsed < seconds and (self.pids or self._backoffs):
            self._poll(min(POLL_PERIOD_S, seconds - elapsed))
            self._start_again()
            elapsed = time.monotonic() - self._began
            if tick(elapsed) is False:
                break
            awaited = [self._nodes[name] for name in until_done if name in self._nodes]
            done = [node for node in awaited if node.done]
            if done and all(node.done or not node.alive for node in awaited):
                self.outcome.finished = len(done) == len(awaited)
                break
        self.outcome.seconds = elapsed

    def end(self) -> Outcome:
        """End every node: SIGINT, after the grace period SIGTERM, at last SIGKILL to its group."""
        tolerated = min(self._interrupts, 1)
        if self.pids:
            self._emit(Event('ending', '', 'ending the nodes'))
        for records in (False, True):
            nodes = [n for c in self._commands if (n := self._nodes.get(c.name)) is not None]
            self._end([n for n in nodes if n.command.records == records], tolerated)
        self._poll(0.0)
        for node in self._nodes.values():
            self._close(node)
        self._nodes.clear()
        self._selector.close()
        self._selector = selectors.DefaultSelector()
        self.outcome.interrupted = self._interrupts > 0
        return self.outcome

    def _on_signal(self, number: int, frame: object) -> None:
        self._interrupts += 1

    def _start_again(self) -> None:
        """Restart dead nodes that are due; the force of a restarted node is off."""
        for name, backoff in list((self._backoffs or {}).items()):
            if backoff.due is not None and time.monotonic() >= backoff.due:
                backoff.started(time.monotonic())
                command = next((c for c in self._commands if c.name == name), None)
                if command is not None:
                    self._close(self._nodes.pop(name))
                    self._start(replace(command, argv=command.argv + command.restart_arguments))

    def _start(self, command: NodeCommand) -> None:
        command = self.e_stop.start_command(command)
        node = NodeProcess(
            command, self._logs / f'{command.name.replace("/", ".")}.log', self._environment
        )
        if command.work in self._places.processes:
            place(node.process.pid, self._places.processes[command.work])
        self._nodes[command.name] = node
        self._selector.register(node.pipe, selectors.EVENT_READ, node)

    def _close(self, node: NodeProcess) -> None:
        if not node.output_closed:
            self._selector.unregister(node.pipe)
        node.close()

    def _wait_ready(self, deadline: float, timeout: float, deaths: int) -> bool:
        while len(self.outcome.deaths) == deaths:
            waiting = [node for node in self._nodes.values() if node.alive and not node.ready]
            if not waiting:
                return True
            if self._interrupts:
                return False
            if time.monotonic() > deadline:
                self.outcome.unready = unready_sentence(waiting, timeout)
                return False
            self._poll(POLL_PERIOD_S)
        return False

    def _poll(self, timeout: float) -> None:
        """Read the output that arrives within `timeout` [s], and register nodes that have ended."""
        if self.e_stop.poll():
            for node in self._nodes.values():
                if node.command.e_stop_arguments and node.alive:
                    node.answer(PRESS)
        if self._selector.get_map():
            for key, _ in self._selector.select(timeout):
                self._read(key.data)
        else:
            time.sleep(timeout)
        for node in self._nodes.values():
            if node.reap():
                self._read(node)
                self._register_end(node)
        self._kill_hung()

    def _kill_hung(self) -> None:
        """Kill nodes that hang. All output that was waiting for the supervisor has been read."""
        now = time.monotonic()
        self._lived += min(now - self._looked, MAX_POLL_GAP_S)
        self._looked = now
        for node in self._nodes.values():
            watched = (
                node.command.has_heartbeat and node.ready and node.alive and not node.asked_to_end
            )
            if watched and not node.hung and self._lived - node.beat > self._timeout_of(node):
                node.hung = True
                node.send_group(signal.SIGKILL)

    def _timeout_of(self, node: NodeProcess) -> float:
        """Return the time without a heartbeat after which a node counts as hung [s]."""
        slow = node.command.records or node.command.converses
        return SLOW_NODE_TIMEOUT_S if slow else self._heartbeat_timeout

    def _read(self, node: NodeProcess) -> None:
        if node.output_closed:
            return
        for line in node.lines():
            if line == f'beat: {node.name}':
                node.beat = self._lived
                continue
            node.log.write(line)
            node.remember(line)
            self._interpret(node, line)
        if node.output_closed:
            self._selector.unregister(node.pipe)

    def _interpret(self, node: NodeProcess, line: str) -> None:
        before = self.e_stop.pressed and not self.e_stop.is_owed
        if self.e_stop.interpret(node.command, line):
            if line == PRESSED and not before:
                self._emit(Event('warning', node.name, 'E-STOP is pressed'))
            return
        if line == f'ready: {node.name}':
            node.ready, node.beat = True, self._lived
            if node.command.work in self._places.receivers:
                place_receivers(node.process.pid, self._places.receivers[node.command.work])
            self._emit(Event('ready', node.name, line))
        elif line == f'done: {node.name}':
            node.done = True
        elif line.startswith(said := f'failed: {node.name}: '):
            self.outcome.failures.append(line.removeprefix(said))
        elif line.startswith('phase: '):
            self._emit(Event('phase', node.name, line.removeprefix('phase: ')))
        elif line.startswith('message: '):
            self._publish(node, line.removeprefix('message: '))
        elif is_warning(line):
            node.warnings += 1
            if node.warnings <= MAX_SHOWN_WARNINGS:
                last = node.warnings == MAX_SHOWN_WARNINGS
                more = ' (further ones are in its log only)' if last else ''
                self._emit(Event('warning', node.name, line + more))

    def _publish(self, node: NodeProcess, text: str) -> None:
        """Publish a message as an event, or the number of messages that could not be read."""
        if (content := parse_message(text)) is not None:
            self._emit(Event('message', node.name, text, content))
            return
        node.unread += 1
        if node.unread.bit_count() == 1:  # the first, the second, the fourth, ...
            many = 'a message' if node.unread == 1 else f'{node.unread} messages so far'
            sentence = f'{many} could not be read, the last of {len(text)} characters: not used'
            self._emit(Event('warning', node.name, sentence))

    def _register_end(self, node: NodeProcess) -> None:
        """Register the end of a process, which is a death or was requested."""
        status = node.process.returncode
        if node.asked_to_end and status not in EXPECTED_STATUSES:
            # An interpreter that is interrupted while it starts reports a fatal error, too.
            crashed = node.crashed and status < 0
            where = f': {" / ".join(node.tail)}' if crashed else ', see its log'
            text = f'{node.name} did not end well ({describe(status)}){where}'
            self._emit(Event('warning', node.name, text))
        if node.asked_to_end or (node.done and status == 0):
            return
        elapsed = None if self._began is None else time.monotonic() - self._began
        hung = self._timeout_of(node) if node.hung else 0.0
        death = Death(node.name, status, elapsed, tuple(node.tail), hung)
        self.outcome.deaths.append(death)
        others = ', '.join(self.pids)
        goes_on = f'; {others} go on' if others and elapsed is not None else ''
        if self._backoffs is not None and elapsed is not None:
            delay = self._backoffs[node.name].died(time.monotonic())
            goes_on += f'; started again in {delay:g} s'
        self._emit(Event('died', node.name, death.sentence + goes_on))

    def _end(self, nodes: Iterable[NodeProcess], tolerated: int) -> None:
        """End some nodes; more interrupts than `tolerated` shorten their grace period."""
        remaining = [node for node in nodes if node.alive]
        for node in remaining:
            node.asked_to_end = True
            node.send(signal.SIGINT)
        asked = time.monotonic()
        hurried = float('inf')
        terminated: set[str] = set()
        while remaining := [node for node in remaining if node.alive]:
            now = time.monotonic()
            if self._interrupts > tolerated:
                hurried = min(hurried, now)
            for node in remaining:
                grace, waited = node.command.grace, now - asked
                too_long = waited > 1.5 * grace
                if too_long or (now - hurried > HURRIED_GRACE_S and not node.command.records):
                    self._kill(node, expected=not too_long)
                elif waited > grace and node.name not in terminated:
                    terminated.add(node.name)
                    node.send(signal.SIGTERM)
            self._poll(POLL_PERIOD_S / 5)

    def _kill(self, node: NodeProcess, *, expected: bool) -> None:
        """Kill a node that does not end; after a second interrupt it is no failure of the node."""
        if not expected:
            self.outcome.killed.append(node.name)
        state = 'has not ended yet' if expected else 'does not end'
        self._emit(Event('killed', node.name, f'{node.name} {state}: killed'))
        node.send_group(signal.SIGKILL)
        node.process.wait()
