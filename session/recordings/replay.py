"""`trainer replay`: a recorded session on the graph again."""

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import rclpy
from rclpy.context import Context
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn

from bags.player import Playhead, RecordedHand, duration
from bags.player_node import HandPlayer, Player, SessionPlayer
from bags.reader import Bag, open_bag
from bags.topics import BUTTON, OF_TISSUE, POSE, REPLAYED, SERVO_CF
from haptic_bridge.realtime import prepare
from session.demo import new_bag
from session.domain import reserved_domain
from session.errors import SessionError
from session.graph import (
    BRIDGE_NODE,
    CUTTING_NODE,
    TISSUE_NODE,
    node_command,
    node_environment,
    recorder_command,
)
from session.keys import Keys
from session.node_process import NodeCommand
from session.processes import Event, Supervisor
from session.recordings.recorded_scene import restore_scene
from session.status import Status

_FOREVER = 1e9
_POLL = 0.05
HELP = 'space: pause; s: one frame; q: end'


@dataclass(frozen=True)
class ReplayOptions:
    """What the command line says.

    Attributes:
        bag: folder of the bag.
        as_recorded: show mesh and forces as they were, instead of driving the simulation.
        rate: seconds of the session in one second.
        start: [s] from its beginning.
        loop: begin again at its end.
        domain: ROS domain, or `free`.
        output: folder of a new bag of the replay; None: none.
        drive_device: force may reach a live device.
    """

    bag: Path
    as_recorded: bool
    rate: float
    start: float
    loop: bool
    domain: int | Literal['free']
    output: Path | None
    drive_device: bool


class _Over(Exception):  # noqa: N818
    """The replay has come to its end."""


def replay(options: ReplayOptions) -> Status:
    """Plays a bag.

    Raises:
        BagError, SessionError, SceneError: it cannot be played like this.
    """
    bag = open_bag(options.bag)
    end = duration(bag)
    if not 0.0 <= options.start < end:
        raise SessionError(
            f'--start {options.start:g}: the session lasts {end:.1f} s, begin before its end'
        )
    with reserved_domain(options.domain) as domain:
        os.environ.update(node_environment(domain))
        context = Context()
        rclpy.init(context=context, domain_id=domain)
        try:
            if options.as_recorded:
                return _show(options, bag, context, end)
            return _drive(options, bag, context, domain)
        finally:
            rclpy.shutdown(context=context)


def _show(options: ReplayOptions, bag: Bag, context: Context, end: float) -> Status:
    playhead = Playhead(options.start, end, rate=options.rate, loop=options.loop)
    player = SessionPlayer(context, playhead, bag, options.start, drive_device=options.drive_device)
    with _Screen(playhead, end) as screen:
        try:
            player.refuse_live_input(player.topics)
            _check(player)
            player.advertise()
            time.sleep(1.0)  # subscribers that are there already hear the first message
            playhead.toggle()
            player.start(prepare)
            while True:
                time.sleep(_POLL)
                screen.tick(player)
        except _Over:
            return Status.OK
        except KeyboardInterrupt:
            return Status.INTERRUPTED
        finally:
            player.stop()


def _drive(options: ReplayOptions, bag: Bag, context: Context, domain: int) -> Status:
    hand = RecordedHand(bag)
    begin, end = max(options.start, hand.span[0]), hand.span[1]
    if begin >= end:
        raise SessionError(f'--start {begin:g}: the last pose is at {end:.1f} s, begin before it')
    playhead = Playhead(begin, end, rate=options.rate, loop=options.loop)
    player = HandPlayer(context, playhead, hand)
    output = None if options.output is None else new_bag(options.output, '')
    with tempfile.TemporaryDirectory(prefix='trainer-') as temporary:
        scene = restore_scene(bag, Path(temporary))
        nodes = replay_nodes(scene, output, drive_device=options.drive_device)
        logs = output / 'log' if output else Path(temporary) / 'log'
        with (
            _Screen(playhead, end) as screen,
            Supervisor(nodes, logs, node_environment(domain), screen.tell) as supervisor,
        ):
            try:
                player.refuse_live_input(
                    [*OF_TISSUE, SERVO_CF, *(REPLAYED + t for t in (POSE, BUTTON))]
                )
                _check(player)
                player.advertise()
                if supervisor.start():
                    player.start(prepare)  # now: a process takes over the priority of its parent
                    supervisor.run(_FOREVER, tick=lambda _: screen.tick(player, supervisor))
            except _Over:
                pass
            finally:
                outcome = supervisor.end()
                player.stop()
    if outcome.unready:
        raise SessionError(outcome.unready)
    if outcome.deaths:
        return Status.NODE_DIED
    if player.faulted is not None:
        screen.say(f'the haptic bridge came to a FAULT at {player.faulted:.2f} s: no force after')
        return Status.FAILED
    return Status.INTERRUPTED if outcome.interrupted else Status.OK


def replay_nodes(scene: Path, output: Path | None, *, drive_device: bool) -> list[NodeCommand]:
    """The nodes that a recorded hand drives.

    They hear poses and button below `/replay`, and their force goes there too: a device that
    listens to `arm/servo_cf` is not reached.

    Args:
        scene: file of the recorded scene.
        output: folder of a new bag; None: nothing is recorded.
        drive_device: leave the force on `arm/servo_cf`, where a device takes it.
    """
    common = {'scene': str(scene), 'seed': 0}
    remapped = {topic[1:]: f'{REPLAYED}{topic}' for topic in (POSE, BUTTON)}
    if not drive_device:
        remapped[SERVO_CF[1:]] = f'{REPLAYED}{SERVO_CF}'
    nodes = [
        node_command(BRIDGE_NODE, common | {'auto_enable': True}, remapped),
        node_command(TISSUE_NODE, common),
        node_command(CUTTING_NODE, common),
    ]
    return nodes if output is None else [*nodes, recorder_command(scene, output, 0)]


def _check(player: Player) -> None:
    if player.refusal:
        raise SessionError(player.refusal)


class _Screen:
    """Progress and keys of a replay; a context manager."""

    def __init__(self, playhead: Playhead, end: float) -> None:
        self._playhead = playhead
        self._keys = Keys()
        self._console = Console(stderr=True)
        self._bar = Progress(
            TextColumn('{task.description}'),
            BarColumn(bar_width=30),
            TextColumn('{task.fields[clock]}'),
            TextColumn(HELP, style='dim'),
            console=self._console,
            transient=True,
            disable=not self._console.is_terminal,
        )
        self._end = end
        self._task = self._bar.add_task('starting', total=end, clock='')

    def __enter__(self) -> '_Screen':
        self._keys.__enter__()
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()
        self._keys.__exit__(None, None, None)

    def tell(self, event: Event) -> None:
        """Shows what a node does."""
        if event.kind != 'ending':
            text = event.text if event.kind != 'warning' else f'{event.node}: {event.text}'
            self.say(text)

    def say(self, text: str) -> None:
        """Shows a line that stays."""
        self._console.print(escape(text), highlight=False)

    def tick(self, player: Player, supervisor: Supervisor | None = None) -> None:
        """Obeys the keys and shows where the replay is.

        Args:
            player: that plays.
            supervisor: of the nodes that it drives; without one of them there is nothing to drive.

        Raises:
            _Over: it has ended, or is to end.
            SessionError: it has to stop.
        """
        _check(player)
        if player.faulted is not None or (supervisor and supervisor.outcome.deaths):
            raise _Over
        act_on(self._keys.pressed(), self._playhead)
        position = self._playhead.position
        self._bar.update(
            self._task,
            description='paused' if self._playhead.paused else 'replaying',
            completed=position,
            clock=f'{position:.2f} of {self._end:.1f} s',
        )
        if self._playhead.over:
            raise _Over


def act_on(keys: str, playhead: Playhead) -> None:
    """Does what keys ask for.

    Raises:
        _Over: to end.
    """
    actions: dict[str, Callable[[], None]] = {' ': playhead.toggle, 's': playhead.step}
    for key in keys:
        if key == 'q':
            raise _Over
        actions.get(key, lambda: None)()
