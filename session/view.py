"""`trainer view`: a session under a page in the browser, as long as the user wants it."""

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rich.console import Console

from session.demo import new_bag, not_run
from session.domain import reserved_domain
from session.errors import SessionError
from session.graph import (
    RECORDER_NODE,
    VIEWER_NODE,
    node_environment,
    recorder_command,
    simulation_nodes,
    viewer_command,
)
from session.node_process import NodeCommand
from session.processes import Event, Outcome, Supervisor
from session.progress import SessionProgress
from session.recordings.changed_scene import write_changed
from session.scene import Scene, load_scene
from session.status import Status
from tissue_sim.errors import MeshError, SceneError

_FOREVER = 1e9


@dataclass(frozen=True)
class ViewOptions:
    """What the command line says.

    Attributes:
        scene: name or path.
        host: address that the page is served on.
        port: of the page; 0: one that is free.
        attach: show the graph that runs in the domain already, and start nothing else.
        seed: of everything random.
        domain: ROS domain, or `free`.
    """

    scene: str
    host: str
    port: int
    attach: bool
    seed: int
    domain: int | Literal['free']


def run_view(options: ViewOptions) -> Status:
    """Serves the page until the user ends it.

    Raises:
        SessionError, SceneError, SettingsError: it cannot be run like this.
    """
    scene = load_scene(options.scene)
    notes = Console(stderr=True)
    viewer = viewer_command(scene.path, options.host, options.port, session=not options.attach)
    if options.attach:
        domain = 0 if options.domain == 'free' else options.domain
        return _attach(viewer, domain, notes)
    with (
        reserved_domain(options.domain) as domain,
        tempfile.TemporaryDirectory(prefix='trainer-') as temporary,
    ):
        session = _Session(scene, options, Path(temporary))
        nodes = [viewer, *session.nodes()]
        with (
            SessionProgress(notes, len(nodes)) as progress,
            Supervisor(
                nodes,
                Path(temporary) / 'log',
                node_environment(domain),
                session.tell(progress),
                restart=True,
            ) as supervisor,
        ):
            if supervisor.start():
                supervisor.run(_FOREVER, tick=lambda _: session.serve(supervisor))
            outcome = supervisor.end()
        return _status(outcome, Path(temporary), notes)


def _attach(viewer: NodeCommand, domain: int, notes: Console) -> Status:
    with (
        tempfile.TemporaryDirectory(prefix='trainer-') as temporary,
        SessionProgress(notes, 1) as progress,
        Supervisor(
            [viewer], Path(temporary) / 'log', node_environment(domain), progress.tell
        ) as supervisor,
    ):
        if supervisor.start():
            supervisor.run(_FOREVER)
        return _status(supervisor.end(), Path(temporary), notes)


def _status(outcome: Outcome, folder: Path, notes: Console) -> Status:
    """The exit status; Ctrl-C is how a view ends."""
    if not outcome.ran:
        return not_run(outcome, folder, notes)
    return Status.OK if outcome.interrupted else Status.NODE_DIED


class _Session:
    """What the page asks of the launcher, done between two looks at the nodes.

    Args:
        scene: to begin with.
        options: of the command line.
        folder: for changed scenes; exists.
    """

    def __init__(self, scene: Scene, options: ViewOptions, folder: Path) -> None:
        self._scene, self._options, self._folder = scene, options, folder
        self._sources = {scene.name: options.scene}  # that the name alone may not lead to
        self._file = scene.path
        self._method: str = scene.cutting.method
        self._recording: Path | None = None
        self._asked: list[dict[str, Any]] = []

    def nodes(self) -> list[NodeCommand]:
        """Those that are started again together."""
        return simulation_nodes(self._file, self._options.seed, self._folder / 'tissue.checkpoint')

    def tell(self, progress: SessionProgress) -> Callable[[Event], None]:
        """What is to be called with the supervisor's events."""

        def tell(event: Event) -> None:
            if event.kind == 'ready' and event.node == VIEWER_NODE:
                self._asked.append({'ask': 'state'})
            if event.kind == 'message':
                message = json.loads(event.text)
                if 'ask' in message:
                    self._asked.append(message)
                    return
            progress.tell(event)

        return tell

    def serve(self, supervisor: Supervisor) -> None:
        """Does what was asked for since the last time."""
        while self._asked:
            request = self._asked.pop(0)
            try:
                self._do(request, supervisor)
                problem = ''
            except (SessionError, SceneError, MeshError, ValueError) as error:
                problem = str(error)
            self._answer(supervisor, problem=problem)

    def _do(self, request: dict[str, Any], supervisor: Supervisor) -> None:
        if request['ask'] == 'restart':
            self._restart(
                request.get('scene', self._scene.name),
                request.get('method', self._method),
                supervisor,
            )
        elif request['ask'] == 'record' and request['on'] != bool(self._recording):
            self._record(request['on'], supervisor)

    def _record(self, on: bool, supervisor: Supervisor) -> None:
        """Begins a bag, or ends one."""
        busy = 'The recorder starts ...' if on else 'The recorder closes its bag ...'
        self._answer(supervisor, busy=busy)
        if on:
            bag = new_bag(None, self._scene.name)
            command = recorder_command(self._file, bag, self._options.seed)
            self._recording = bag
            if not supervisor.replace([command]):
                self._recording = None
                raise SessionError('the recorder did not start: its log says why')
        else:
            supervisor.remove([RECORDER_NODE])
            self._recording = None

    def _restart(self, name: str, method: str, supervisor: Supervisor) -> None:
        """Begins anew: a bag holds one tissue, so that one is ended, and another begun."""
        scene = load_scene(self._sources.get(name, name))
        changes = {} if method == scene.cutting.method else {'cutting.method': method}
        if scene.name != self._scene.name and method == self._method:
            changes, method = {}, scene.cutting.method  # another scene comes with its own method
        recorded = self._recording is not None
        self._answer(supervisor, busy='The nodes start again ...')
        if recorded:
            supervisor.remove([RECORDER_NODE])
            self._recording = None
        self._scene, self._method = scene, method
        self._file = write_changed(scene, self._folder, changes) if changes else scene.path
        if not supervisor.replace(self.nodes()):
            outcome = supervisor.outcome
            why = outcome.unready or (outcome.deaths[-1].sentence if outcome.deaths else '')
            raise SessionError(why or 'the start was interrupted')
        if recorded:
            self._record(True, supervisor)

    def _answer(self, supervisor: Supervisor, *, busy: str = '', problem: str = '') -> None:
        state = {
            'scene': self._scene.name,
            'method': self._method,
            'recording': str(self._recording or ''),
            'busy': busy,
            'problem': problem,
            'scene_file': '' if busy else str(self._file),
        }
        supervisor.answer(VIEWER_NODE, json.dumps(state))
