"""Starts the nodes of a session, watches them and ends them; nothing is left running."""

import selectors
import signal
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from session.node_process import NodeCommand, NodeProcess, is_warning
from session.restarts import Backoff

STOPPING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
POLL = 0.05  # [s]
MOST_SHOWN = 20
HURRY = 1.0
"""What is left to the nodes [s] when the user interrupts again."""
ASKED_FOR = (0, -signal.SIGINT, -signal.SIGTERM)


@dataclass(frozen=True)
class Event:
    """What the supervisor tells while it works; `text` is a sentence or a node's own line."""

    kind: Literal['ready', 'phase', 'message', 'warning', 'died', 'ending', 'killed']
    node: str
    text: str


@dataclass(frozen=True)
class Death:
    """A node that ended although nobody asked it to.

    Attributes:
        node: its name.
        returncode: exit status, or the negative number of the signal.
        elapsed: [s] since the session started to run; None before every node was ready.
        tail: the last lines that it wrote.
    """

    node: str
    returncode: int
    elapsed: float | None
    tail: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """Who died, how and when."""
        when = 'before it was ready' if self.elapsed is None else f'after {self.elapsed:.1f} s'
        return f'{self.node} died {when} ({describe(self.returncode)})'


@dataclass
class Outcome:
    """How a session went, as far as its processes can tell.

    Attributes:
        ran: every node was ready.
        finished: the node that was waited for said `done: NAME`.
        interrupted: the user, or the system, asked for the end.
        seconds: [s] from the last node being ready to the end.
        deaths: of nodes, in order.
        unready: sentence about who was not ready in time.
        killed: nodes that did not end when asked to, in all the time that they have for it.
        failures: what nodes said in lines `failed: NAME: sentence`.
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


class Supervisor:
    """Runs a set of nodes to the end of a session; use it as a context manager.

    Everything happens in the calling thread, which must be the main one: the kernel ties the life
    of the processes to it. SIGINT, SIGTERM and SIGHUP end the session in order; after a second one
    what has not ended within a second is killed, except nodes that record. Each node has a process
    group of its own, so that a terminal's Ctrl-C reaches the supervisor alone.

    Args:
        commands: the nodes in the order in which they are ended, those that record last.
        log_folder: gets one file a node as soon as the folder above it exists.
        environment: of every node.
        tell: is called with what happens.
        restart: start nodes that die again, with `NodeCommand.again`.
    """

    def __init__(
        self,
        commands: Sequence[NodeCommand],
        log_folder: Path,
        environment: Mapping[str, str],
        tell: Callable[[Event], None] = lambda event: None,
        *,
        restart: bool = False,
    ) -> None:
        self.outcome = Outcome()
        self._commands = commands
        self._logs = log_folder
        self._environment = environment
        self._tell = tell
        self._nodes: dict[str, NodeProcess] = {}
        self._selector = selectors.DefaultSelector()
        self._interrupts = 0
        self._began: float | None = None
        self._handlers: dict[int, object] = {}
        self._backoffs: defaultdict[str, Backoff] | None = defaultdict(Backoff) if restart else None

    def __enter__(self) -> 'Supervisor':
        for number in STOPPING_SIGNALS:
            self._handlers[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.end()
        finally:
            for number, handler in self._handlers.items():
                signal.signal(number, handler)  # type: ignore[arg-type]

    @property
    def pids(self) -> dict[str, int]:
        """Process ids of the nodes that live, by name."""
        return {name: node.process.pid for name, node in self._nodes.items() if node.alive}

    def start(self, timeout: float = 60.0) -> bool:
        """Starts the nodes that record, waits for them, and then starts the others.

        Args:
            timeout: [s] in which all must be ready.

        Returns:
            Whether all are ready; if not, the outcome says why.
        """
        if not self._start_all(self._commands, timeout):
            return False
        self._began = time.monotonic()
        self.outcome.ran = True
        return True

    def replace(self, commands: Sequence[NodeCommand], timeout: float = 60.0) -> bool:
        """Ends the nodes of some names, where they run, and starts these in their stead.

        Args:
            commands: to run from now on.
            timeout: [s] in which all must be ready.

        Returns:
            Whether all are ready; if not, the outcome says why, and `remove` takes back the rest.
        """
        self.remove([command.name for command in commands])
        self.outcome.unready = ''
        kept = [c for c in self._commands if all(c.name != new.name for new in commands)]
        self._commands = [*kept, *commands]
        return self._start_all(commands, timeout)

    def remove(self, names: Collection[str]) -> None:
        """Ends some nodes; those that record after the others."""
        for records in (False, True):
            nodes = [node for name, node in self._nodes.items() if name in names]
            self._end([node for node in nodes if node.command.records == records], 0)
        self._poll(0.0)
        for name in names:
            if (node := self._nodes.pop(name, None)) is not None:
                self._close(node)

    def signal(self, name: str, number: signal.Signals) -> None:
        """Sends a signal to a node that lives; what becomes of it is an accident, as any."""
        if name in self.pids:
            self._nodes[name].send(number)

    def answer(self, name: str, text: str) -> None:
        """Writes a line to a node that converses."""
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
        until_done: str = '',
        tick: Callable[[float], object] = lambda elapsed: None,
    ) -> None:
        """Watches the session until it is over; deaths are told, and the other nodes go on.

        Args:
            seconds: [s] that it lasts at most.
            until_done: the node whose line `done: NAME` ends it.
            tick: is called often with the elapsed time [s]; the session is over when it is False.
        """
        assert self._began is not None, 'start() first'
        elapsed = 0.0
        while not self._interrupts and elapsed < seconds and (self.pids or self._backoffs):
            self._poll(min(POLL, seconds - elapsed))
            self._start_again()
            elapsed = time.monotonic() - self._began
            if tick(elapsed) is False:
                break
            if until_done in self._nodes and self._nodes[until_done].done:
                self.outcome.finished = True
                break
        self.outcome.seconds = elapsed

    def end(self) -> Outcome:
        """Ends every node: SIGINT, after the grace SIGTERM, at last SIGKILL to its group."""
        patience = min(self._interrupts, 1)
        if self.pids:
            self._tell(Event('ending', '', 'ending the nodes'))
        for records in (False, True):
            nodes = [n for c in self._commands if (n := self._nodes.get(c.name)) is not None]
            self._end([n for n in nodes if n.command.records == records], patience)
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
        """Starts what died, once it is time; a node that comes back never brings force with it."""
        for name, backoff in (self._backoffs or {}).items():
            if backoff.due is not None and time.monotonic() >= backoff.due:
                backoff.started(time.monotonic())
                command = next((c for c in self._commands if c.name == name), None)
                if command is not None:
                    self._close(self._nodes.pop(name))
                    self._start(replace(command, argv=command.argv + command.again))

    def _start(self, command: NodeCommand) -> None:
        node = NodeProcess(command, self._logs / f'{command.name}.log', self._environment)
        self._nodes[command.name] = node
        self._selector.register(node.pipe, selectors.EVENT_READ, node)

    def _close(self, node: NodeProcess) -> None:
        if not node.silent:
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
                self.outcome.unready = _unready(waiting, timeout)
                return False
            self._poll(POLL)
        return False

    def _poll(self, timeout: float) -> None:
        """Reads what has come within `timeout` [s] and takes note of who has ended."""
        if self._selector.get_map():
            for key, _ in self._selector.select(timeout):
                self._read(key.data)
        else:
            time.sleep(timeout)
        for node in self._nodes.values():
            if node.reap():
                self._read(node)
                self._take_note(node)

    def _read(self, node: NodeProcess) -> None:
        if node.silent:
            return
        for line in node.lines():
            node.log.write(line)
            if line:
                node.tail.append(line)
            self._interpret(node, line)
        if node.silent:
            self._selector.unregister(node.pipe)

    def _interpret(self, node: NodeProcess, line: str) -> None:
        if line == f'ready: {node.name}':
            node.ready = True
            self._tell(Event('ready', node.name, line))
        elif line == f'done: {node.name}':
            node.done = True
        elif line.startswith(said := f'failed: {node.name}: '):
            self.outcome.failures.append(line.removeprefix(said))
        elif line.startswith(('phase: ', 'message: ')):
            kind, _, text = line.partition(': ')
            self._tell(Event('phase' if kind == 'phase' else 'message', node.name, text))
        elif is_warning(line):
            node.warnings += 1
            if node.warnings <= MOST_SHOWN:
                more = '' if node.warnings < MOST_SHOWN else ' (further ones are in its log only)'
                self._tell(Event('warning', node.name, line + more))

    def _take_note(self, node: NodeProcess) -> None:
        """Of the end of a process: a death, or as it was asked."""
        status = node.process.returncode
        if node.asked_to_end and status not in ASKED_FOR:
            text = f'{node.name} did not end well ({describe(status)}), see its log'
            self._tell(Event('warning', node.name, text))
        if node.asked_to_end or (node.done and status == 0):
            return
        elapsed = None if self._began is None else time.monotonic() - self._began
        death = Death(node.name, status, elapsed, tuple(node.tail))
        self.outcome.deaths.append(death)
        others = ', '.join(self.pids)
        goes_on = f'; {others} go on' if others and elapsed is not None else ''
        if self._backoffs is not None and elapsed is not None:
            delay = self._backoffs[node.name].died(time.monotonic())
            goes_on += f'; started again in {delay:g} s'
        self._tell(Event('died', node.name, death.sentence + goes_on))

    def _end(self, nodes: Iterable[NodeProcess], patience: int) -> None:
        """Ends some nodes; more than `patience` interrupts are a hurry."""
        remaining = [node for node in nodes if node.alive]
        for node in remaining:
            node.asked_to_end = True
            node.send(signal.SIGINT)
        asked = time.monotonic()
        hurried = float('inf')
        terminated: set[str] = set()
        while remaining := [node for node in remaining if node.alive]:
            now = time.monotonic()
            if self._interrupts > patience:
                hurried = min(hurried, now)
            for node in remaining:
                grace, waited = node.command.grace, now - asked
                too_long = waited > 1.5 * grace
                if too_long or (now - hurried > HURRY and not node.command.records):
                    self._kill(node, expected=not too_long)
                elif waited > grace and node.name not in terminated:
                    terminated.add(node.name)
                    node.send(signal.SIGTERM)
            self._poll(POLL / 5)

    def _kill(self, node: NodeProcess, *, expected: bool) -> None:
        """Kills a node that does not end; in a hurry that is no failure of its own."""
        if not expected:
            self.outcome.killed.append(node.name)
        what = 'has not ended yet' if expected else 'does not end'
        self._tell(Event('killed', node.name, f'{node.name} {what}: killed'))
        node.send_group(signal.SIGKILL)
        node.process.wait()


def describe(returncode: int) -> str:
    """By which signal or exit status a process ended."""
    if returncode < 0:
        return f'killed by {signal.Signals(-returncode).name}'
    return f'exit status {returncode}'


def _unready(waiting: Sequence[NodeProcess], timeout: float) -> str:
    said = '; '.join(
        f'{node.name} said last: {" / ".join(node.tail) or "nothing"}' for node in waiting
    )
    names = ' and '.join(node.name for node in waiting)
    hint = 'does the machine do something else? ./trainer doctor'
    return f'{names} not ready within {timeout:g} s ({hint}); {said}'
