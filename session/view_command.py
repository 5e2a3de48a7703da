"""`trainer view`: a session that is controlled from a page in the browser."""

import json
import os
import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from rich.console import Console

from cutting_trainer.exercises.attempt_store import new_pseudonym
from cutting_trainer.haptic_bridge.devices.convention import METRES
from cutting_trainer.node_common.errors import MeshError, SceneError
from cutting_trainer.node_common.share_folder import scene_names
from cutting_trainer.session.attempts import attempt_data
from cutting_trainer.session.beside_page import Address, AttemptList, ReplayServer
from cutting_trainer.session.demo_command import new_bag, report_failed_start
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import (
    RECORDER_NODE,
    VIEWER_NODE,
    node_environment,
    recorder_command,
    simulation_nodes,
    viewer_command,
)
from cutting_trainer.session.node_process import NodeCommand
from cutting_trainer.session.outcome import Outcome
from cutting_trainer.session.probe_command import ProbeOptions, probe
from cutting_trainer.session.progress import SessionProgress
from cutting_trainer.session.scene_loader import Scene, load_scene, require_frames
from cutting_trainer.session.scene_overrides import tissue_changes, write_changed
from cutting_trainer.session.supervisor import Event, Supervisor
from cutting_trainer.session.terminal import session_console
from cutting_trainer.viewer.access_control import INSTRUCTOR_VARIABLE, TOKEN_VARIABLE, make_gate
from cutting_trainer.viewer.allowed_requests import TISSUE_FACTORS
from cutting_trainer.viewer.live_page import METHODS, OWN_TISSUE

_FOREVER = 1e9
_MAX_REQUESTS = 16
"""Longest queue of requests; further ones are discarded."""


@dataclass(frozen=True)
class ViewOptions:
    """Options of `view`.

    Attributes:
        scene: name or path.
        host: address of the page.
        port: port of the page; 0: any free port.
        attach: show the graph that runs in the domain already, and start only the viewer.
        seed: seed of all random numbers.
        domain: ROS domain, or `free`.
        allow_host: host names under which the page is served.
        arm: namespace of a device whose driver runs; '': the emulated arm.
        record: record from the start.
    """

    scene: str
    host: str
    port: int
    attach: bool
    seed: int
    domain: int | Literal['free']
    allow_host: tuple[str, ...] = ()
    arm: str = ''
    record: bool = False


def run_view(options: ViewOptions) -> Status:
    """Serve the page until the user ends it.

    Raises:
        PageError, SessionError, SceneError, SettingsError: an option or the scene is not valid.
    """
    scene = load_scene(options.scene)
    require_frames(scene)
    notes = session_console()
    if options.arm:
        require_device(options, scene, notes)
    # Rejected here, before the start of any node; every start of the viewer has the token.
    gate = make_gate(options.host, options.allow_host)
    os.environ[TOKEN_VARIABLE] = gate.token
    os.environ[INSTRUCTOR_VARIABLE] = gate.instructor_token
    viewer = viewer_command(
        scene.path,
        options.host,
        options.port,
        session=not options.attach,
        allow_host=options.allow_host,
        arm=options.arm,
    )
    if options.attach:
        domain = 0 if options.domain == 'free' else options.domain
        return _attach(viewer, domain, notes)
    with (
        reserved_domain(options.domain) as domain,
        tempfile.TemporaryDirectory(prefix='trainer-') as temporary,
        ExitStack() as stack,
    ):
        session = _Session(scene, options, Path(temporary), notes)
        stack.callback(session.close)
        nodes = [viewer, *session.nodes(), *session.recorder()]
        with (
            SessionProgress(notes, len(nodes)) as progress,
            Supervisor(
                nodes,
                Path(temporary) / 'log',
                node_environment(domain),
                session.event_handler(progress),
                restart=True,
            ) as supervisor,
        ):
            if supervisor.start():
                supervisor.run(_FOREVER, tick=lambda _: session.serve(supervisor))
            outcome = supervisor.end()
        return _status(outcome, Path(temporary), notes)


def require_device(options: ViewOptions, scene: Scene, notes: Console) -> None:
    """Check the device of a session, by what its driver sends.

    Args:
        options: of the command line.
        scene: whose profile and topics the device has.
        notes: console for what is done.

    Raises:
        SessionError: the device cannot be used; the message has the reasons.
    """
    if options.domain == 'free':
        raise SessionError('--arm: the driver runs in a ROS domain: name that, not --domain free')
    device = scene.device
    metres = METRES[device.length_unit]
    os.environ.update(node_environment(options.domain))
    checks = probe(
        ProbeOptions(options.arm, moves=False, force_topic=device.force_topic, metres=metres),
        scene.profile,
        notes,
    )
    wrong = [check.sentence for check in checks if check.verdict == 'wrong']
    if wrong:
        raise SessionError(f'--arm {options.arm}: {"; ".join(wrong)}')


def _attach(viewer: NodeCommand, domain: int, notes: Console) -> Status:
    with (
        tempfile.TemporaryDirectory(prefix='trainer-') as temporary,
        SessionProgress(notes, 1) as progress,
        Supervisor(
            [viewer], Path(temporary) / 'log', node_environment(domain), progress.show
        ) as supervisor,
    ):
        if supervisor.start():
            supervisor.run(_FOREVER)
        return _status(supervisor.end(), Path(temporary), notes)


def _status(outcome: Outcome, folder: Path, notes: Console) -> Status:
    """Return the exit status; Ctrl-C is the normal end of a view."""
    if not outcome.ran:
        return report_failed_start(outcome, folder, notes)
    return Status.OK if outcome.interrupted else Status.NODE_DIED


class _Session:
    """Serve the requests of the page to the launcher, between two polls of the nodes.

    Args:
        scene: first scene.
        options: options of the command line.
        folder: existing folder for changed scenes.
        notes: console for details that the page must not have.
    """

    def __init__(self, scene: Scene, options: ViewOptions, folder: Path, notes: Console) -> None:
        self._scene, self._options, self._folder = scene, options, folder
        self._notes = notes
        self._sources = {scene.name: options.scene}  # the name alone may not lead to the file
        self._file = scene.path
        self._method: str = scene.cutting.method
        self._tissue = OWN_TISSUE
        self._recording: Path | None = None
        self._subject, self._is_attempt = '', False
        self._attempts = AttemptList()
        self._replays = ReplayServer(Address(options.host, options.port, options.allow_host))
        self._is_new = True  # the viewer does not have the scene file of the nodes yet
        self._asked: list[dict[str, Any]] = []

    def nodes(self) -> list[NodeCommand]:
        """Return the commands of the nodes that restart together."""
        tools = [tool.label for tool in self._scene.others]
        checkpoint = self._folder / 'tissue.checkpoint'
        arm = self._options.arm
        return simulation_nodes(self._file, self._options.seed, checkpoint, tools, arm)

    def recorder(self) -> list[NodeCommand]:
        """Return the command of the recorder, where it is to record from the start."""
        if not self._options.record:
            return []
        self._recording = new_bag(None, self._scene.name)
        return [self._recorder_command(self._recording)]

    def _recorder_command(self, bag: Path) -> NodeCommand:
        """Return the command of the recorder; the bag of an exercise says whose attempt it is."""
        said = {}
        if self._scene.exercise.title:
            self._subject = self._subject or new_pseudonym()
            said = attempt_data(bag.parent, self._file.stem, self._subject, '')
        return recorder_command(self._file, bag, self._options.seed, said)

    def close(self) -> None:
        """End the programs beside the session."""
        self._attempts.end()
        self._replays.end()

    def event_handler(self, progress: SessionProgress) -> Callable[[Event], None]:
        """Return a handler of the supervisor's events."""

        def handle(event: Event) -> None:
            if event.kind == 'ready' and event.node == VIEWER_NODE:
                self._asked.append({'ask': 'state'})
            if event.kind == 'message' and 'ask' in event.content:
                if len(self._asked) < _MAX_REQUESTS:
                    self._asked.append(dict(event.content))
                return
            progress.show(event)

        return handle

    def serve(self, supervisor: Supervisor) -> None:
        """Serve the requests since the last call."""
        while self._asked:
            request = self._asked.pop(0)
            problem = self._try(partial(self._do, request, supervisor))
            self._answer(supervisor, problem=problem)
        for tell in (self._tell_attempts, self._tell_replay):
            if problem := self._try(partial(tell, supervisor)):
                self._answer(supervisor, problem=problem)

    def _try(self, job: Callable[[], None]) -> str:
        """Do something; return why it failed, for the page; '' where it did not."""
        try:
            job()
        except (SessionError, SceneError, MeshError, ValueError) as error:
            self._notes.print(f'asked by the page: {error}', style='red', markup=False)
            return 'This could not be done: the terminal says why.'
        except (KeyError, TypeError):  # no page of ours asks so
            return 'The request of the page could not be understood: nothing was done.'
        return ''

    def _tell_attempts(self, supervisor: Supervisor) -> None:
        if (rows := self._attempts.news()) is not None:
            self._answer(supervisor, attempts=rows)

    def _tell_replay(self, supervisor: Supervisor) -> None:
        if (served := self._replays.news()) is not None:
            self._answer(supervisor, replay=served)

    def _do(self, request: dict[str, Any], supervisor: Supervisor) -> None:
        if request['ask'] == 'restart':
            name = request.get('scene', self._scene.name)
            if name not in (*self._sources, *scene_names()):
                raise SessionError('the requested scene is not one of those on offer')
            if (method := request.get('method', self._method)) not in METHODS:
                raise SessionError('the requested method of cutting does not exist')
            self._restart(name, method, supervisor, _tissue(request.get('tissue', self._tissue)))
        elif request['ask'] == 'attempt':
            self._begin_attempt(request['scene'], request['subject'], supervisor)
        elif request['ask'] == 'finish':  # the attempt has a score
            if self._is_attempt and self._recording is not None:
                self._record(False, supervisor)
        elif request['ask'] == 'watch':
            bags = [self._attempts.bag(name) for name in request['bags']]
            self._replays.show(bags, int(request['number']))
        elif request['ask'] == 'state':  # the viewer has just started
            self._is_new = True
            self._attempts.refresh()
        elif request['ask'] == 'record' and request.get('on') is (self._recording is None):
            self._record(request['on'], supervisor)

    def _begin_attempt(self, name: str, subject: str, supervisor: Supervisor) -> None:
        """Restart the nodes with an exercise, and record it from the start."""
        if name not in scene_names() or not (scene := load_scene(name)).exercise.title:
            raise SessionError('the requested exercise is not one of those on offer')
        self._subject = str(subject) or self._subject
        self._restart(name, scene.cutting.method, supervisor, OWN_TISSUE, attempt=True)

    def _record(self, on: bool, supervisor: Supervisor) -> None:
        """Start a bag, or end the present one."""
        busy = 'The recorder starts ...' if on else 'The recorder closes its bag ...'
        self._answer(supervisor, busy=busy)
        if on:
            bag = new_bag(None, self._scene.name)
            command = self._recorder_command(bag)
            self._recording = bag
            if not supervisor.replace([command]):
                supervisor.remove([RECORDER_NODE])
                self._recording = None
                raise SessionError('the recorder did not start: its log has the reason')
        else:
            self._end_bag(supervisor)

    def _end_bag(self, supervisor: Supervisor) -> None:
        supervisor.remove([RECORDER_NODE])
        self._recording, self._is_attempt = None, False
        self._attempts.refresh()

    def _restart(
        self,
        name: str,
        method: str,
        supervisor: Supervisor,
        tissue: dict[str, float],
        *,
        attempt: bool = False,
    ) -> None:
        """Restart the nodes. A bag holds one tissue: the present one ends, and a new one starts.

        Args:
            name: of the scene.
            method: of cutting.
            supervisor: of the nodes.
            tissue: factors of stiffness and toughness; another scene has its own.
            attempt: record an attempt from the start.
        """
        scene = load_scene(self._sources.get(name, name))
        changes = {} if method == scene.cutting.method else {'cutting.method': method}
        if scene.name != self._scene.name and method == self._method:
            changes, method = {}, scene.cutting.method  # another scene has its own method
        if scene.name != self._scene.name:
            tissue = OWN_TISSUE
        changes |= tissue_changes(scene.tissue, tissue)
        recorded, again = self._recording is not None, self._is_attempt
        self._answer(supervisor, busy='The nodes start again ...')
        if recorded:
            self._end_bag(supervisor)
        before = [command.name for command in self.nodes()]
        self._scene, self._method, self._tissue = scene, method, tissue
        # Scores with another tissue do not compare: they are of an exercise of another name.
        name = scene.name if tissue == OWN_TISSUE else _name(scene.name, tissue)
        self._file = write_changed(scene, self._folder, changes, name) if changes else scene.path
        self._is_new = True  # the file may have changed under the same name
        nodes = self.nodes()
        supervisor.remove(set(before) - {command.name for command in nodes})
        if not supervisor.replace(nodes):
            outcome = supervisor.outcome
            why = outcome.unready or (outcome.deaths[-1].sentence if outcome.deaths else '')
            raise SessionError(why or 'the start was interrupted')
        if recorded or attempt:
            self._record(True, supervisor)
        self._is_attempt = attempt or (again and bool(scene.exercise.title))

    def _answer(
        self, supervisor: Supervisor, *, busy: str = '', problem: str = '', **news: object
    ) -> None:
        """Tell the page the state of the session, with what is new.

        Args:
            supervisor: of the nodes.
            busy: activity that blocks the session.
            problem: why a request failed.
            news: further attributes of `SessionState`.
        """
        sends_file = self._is_new and not busy
        state = {
            'scene': self._scene.name,
            'method': self._method,
            'tissue': self._tissue,
            'recording': self._recording.name if self._recording else '',
            'busy': busy,
            'problem': problem,
            'scene_file': str(self._file) if sends_file else '',
            **news,
        }
        self._is_new = self._is_new and not sends_file
        supervisor.answer(VIEWER_NODE, json.dumps(state))


def _name(scene: str, tissue: Mapping[str, float]) -> str:
    """Return the name of a scene with another tissue, as `pad-stiffness-1.5-toughness-1`."""
    return '-'.join([scene, *(f'{name}-{factor:g}' for name, factor in tissue.items())])


def _tissue(asked: Mapping[str, float]) -> dict[str, float]:
    """Return the requested factors of the tissue.

    Raises:
        SessionError: one is not on offer.
    """
    low, high = TISSUE_FACTORS
    factors = {name: float(asked[name]) for name in OWN_TISSUE}
    if not all(low <= factor <= high for factor in factors.values()):
        raise SessionError('the requested tissue is not one of those on offer')
    return factors
