"""`trainer replay`: play a recorded session into the graph."""

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import rclpy
from rclpy.context import Context
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn

from cutting_trainer.bags.playback_control import Playhead
from cutting_trainer.bags.playback_messages import RecordedHand, duration
from cutting_trainer.bags.playback_publishers import HandPlayer, Player, SessionPlayer
from cutting_trainer.bags.reader import Bag, open_bag
from cutting_trainer.bags.recorded_frames import first_keyframe
from cutting_trainer.bags.recorded_tissue import first_current_keyframe
from cutting_trainer.bags.topic_names import (
    BUTTONS,
    FORCES,
    OF_TISSUE,
    POSE,
    REPLAYED,
    further_tools,
)
from cutting_trainer.node_common.realtime import prepare
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.session.demo_command import new_bag
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import (
    BRIDGE_NODE,
    CUTTING_NODE,
    TISSUE_NODE,
    node_command,
    node_environment,
    recorder_command,
)
from cutting_trainer.session.node_process import NodeCommand
from cutting_trainer.session.supervisor import Event, Supervisor
from cutting_trainer.session.terminal import session_console
from cutting_trainer.session.terminal_keys import Keys

_FOREVER = 1e9
_POLL_PERIOD_S = 0.05
HELP = 'space: pause; s: one frame; e: E-STOP; q: end'


@dataclass(frozen=True)
class ReplayOptions:
    """Options of `replay`.

    Attributes:
        bag: folder of the bag.
        as_recorded: publish the recorded mesh and forces, instead of driving the simulation.
        rate: speed, as seconds of the session per second.
        start: start, from the beginning of the session [s].
        loop: repeat at the end.
        domain: ROS domain, or `free`.
        output: folder of a new bag of the replay; None: not recorded.
        drive_device: publish the force to a live device.
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
    """Play a bag.

    Raises:
        BagError, SessionError, SceneError: an option or the bag is not valid.
    """
    if options.as_recorded and options.output is not None:
        raise SessionError('--output records a computed replay: leave --as-recorded or it out')
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
            player.reject_live_input(player.topics)
            _check(player)
            player.advertise()
            time.sleep(1.0)  # subscribers that are there already hear the first message
            playhead.toggle()
            player.start(prepare)
            while True:
                time.sleep(_POLL_PERIOD_S)
                screen.tick(player)
        except _Over:
            return Status.OK
        except KeyboardInterrupt:
            return Status.INTERRUPTED
        finally:
            player.stop()


def _drive(options: ReplayOptions, bag: Bag, context: Context, domain: int) -> Status:
    if further_tools(bag.topics()):
        raise SessionError(
            f'{bag.path} has several tools, and a replay moves one: add --as-recorded'
        )
    hand = RecordedHand(bag)
    begin, end = max(options.start, hand.span[0]), hand.span[1]
    if begin >= end:
        raise SessionError(f'--start {begin:g}: the last pose is at {end:.1f} s, begin before it')
    playhead = Playhead(begin, end, rate=options.rate, loop=options.loop)
    player = HandPlayer(context, playhead, hand)
    output = None if options.output is None else new_bag(options.output, '')
    with tempfile.TemporaryDirectory(prefix='trainer-') as temporary:
        scene = restore_scene(bag, Path(temporary))
        nodes = replay_nodes(
            scene,
            output,
            drive_device=options.drive_device,
            tissue=tissue_in_the_middle(bag, Path(temporary)),
        )
        logs = output / 'log' if output else Path(temporary) / 'log'
        with (
            _Screen(playhead, end) as screen,
            Supervisor(
                nodes, logs, node_environment(domain), screen.show, keys=False
            ) as supervisor,
        ):
            try:
                player.reject_live_input(
                    [*OF_TISSUE, *FORCES, *(REPLAYED + t for t in (POSE, *BUTTONS))]
                )
                _check(player)
                player.advertise()
                if supervisor.start():
                    player.start(prepare)  # not earlier: processes inherit their parent's priority
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


def tissue_in_the_middle(bag: Bag, folder: Path) -> Path | None:
    """Write the first tissue of a bag that starts within a session, and return its file, else None.

    The simulation starts from its shape and its cuts, at rest.

    Args:
        bag: bag of the session.
        folder: existing folder to write to.
    """
    first = first_current_keyframe(bag)
    if first is None:
        return None
    scene = first_keyframe(bag)
    if scene.step == 0 and scene.topology == bag.read(first).topology:
        return None
    path = folder / 'tissue.checkpoint'
    path.write_bytes(first.data)
    return path


def replay_nodes(
    scene: Path, output: Path | None, *, drive_device: bool, tissue: Path | None = None
) -> list[NodeCommand]:
    """Return the commands of the nodes that a recorded hand drives.

    They take poses and button from topics below `/replay`, and publish their force there too, so
    that it does not reach a device that takes `arm/servo_cf`.

    Args:
        scene: file of the recorded scene.
        output: folder of a new bag; None: not recorded.
        drive_device: publish the force to the device.
        tissue: file of the initial tissue; None: that of the scene.
    """
    resumed = {} if tissue is None else {'resume': True, 'checkpoint': str(tissue)}
    common = {'scene': str(scene), 'seed': 0}
    remapped = {topic[1:]: f'{REPLAYED}{topic}' for topic in (POSE, *BUTTONS)}
    if not drive_device:
        remapped |= {topic[1:]: f'{REPLAYED}{topic}' for topic in FORCES}
    nodes = [
        node_command(BRIDGE_NODE, common | {'auto_enable': True}, remapped),
        node_command(TISSUE_NODE, common | resumed),
        node_command(CUTTING_NODE, common),
    ]
    return nodes if output is None else [*nodes, recorder_command(scene, output, 0)]


def _check(player: Player) -> None:
    if player.stop_reason:
        raise SessionError(player.stop_reason)


class _Screen:
    """Progress and keys of a replay; a context manager."""

    def __init__(self, playhead: Playhead, end: float) -> None:
        self._playhead = playhead
        self._keys = Keys()
        self._console = session_console()
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

    def show(self, event: Event) -> None:
        """Show an event of a node."""
        if event.kind != 'ending':
            text = event.text if event.kind != 'warning' else f'{event.node}: {event.text}'
            self.say(text)

    def say(self, text: str) -> None:
        """Print a permanent line."""
        self._console.print(escape(text), highlight=False)

    def tick(self, player: Player, supervisor: Supervisor | None = None) -> None:
        """Handle the keys and show the progress of the replay.

        Args:
            player: player of the session.
            supervisor: supervisor of the driven nodes; the replay ends if one of them dies.

        Raises:
            _Over: the replay has ended, or must end.
            SessionError: the player refuses to go on.
        """
        _check(player)
        if player.faulted is not None or (supervisor and supervisor.outcome.deaths):
            raise _Over
        pressed = self._keys.pressed()
        if supervisor is not None and 'e' in pressed.lower():
            supervisor.e_stop.ask()
        handle_keys(pressed, self._playhead)
        position = self._playhead.position
        self._bar.update(
            self._task,
            description='paused' if self._playhead.paused else 'replaying',
            completed=position,
            clock=f'{position:.2f} of {self._end:.1f} s',
        )
        if self._playhead.over:
            raise _Over


def handle_keys(keys: str, playhead: Playhead) -> None:
    """Handle keys.

    Raises:
        _Over: q was pressed.
    """
    actions: dict[str, Callable[[], None]] = {' ': playhead.toggle, 's': playhead.step}
    for key in keys:
        if key == 'q':
            raise _Over
        actions.get(key, lambda: None)()
