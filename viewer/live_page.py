"""Page of a live session: its content, update rates and allowed requests."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, get_args

import numpy as np

from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.exercises.scene_schema import ExerciseSettings
from cutting_trainer.haptic_bridge.force_kernels import INSIDE
from cutting_trainer.haptic_bridge.scene_schema import ToolSettings
from cutting_trainer.tissue_sim.mesh.depth import SurfaceDepth
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica
from cutting_trainer.viewer import plots
from cutting_trainer.viewer.allowed_requests import LiveControls
from cutting_trainer.viewer.appearance import (
    FLOOR,
    METRES_PER_NEWTON,
    camera,
    reach,
    shown_exercise,
    shown_tissue,
    tool_shape,
)
from cutting_trainer.viewer.attempt_progress import AttemptProgress
from cutting_trainer.viewer.drawn_surface import TissueSource
from cutting_trainer.viewer.page_protocol import MAX_NAME, VERSION
from cutting_trainer.viewer.page_server import PageServer
from cutting_trainer.viewer.ring_buffers import History
from cutting_trainer.viewer.tool_state import Moment

TITLE = 'Cutting trainer'
METHODS: tuple[str, ...] = get_args(CuttingSettings.model_fields['method'].annotation)
SCALE = (0.1, 3.0)
"""Range of force scales; a present one beyond it widens the range."""
OWN_TISSUE: dict[str, float] = {'stiffness': 1.0, 'toughness': 1.0}
"""Factors of the tissue as its scene has it."""
PLOT_SPAN_S = 15.0
"""[s] Time span of the plots."""
_PLOT_PERIOD_S, _TABLE_PERIOD_S = 0.2, 0.5
_SAMPLES, _EVERY = round(PLOT_SPAN_S * 30), 3
"""Number of samples kept, and of samples per plotted point."""
_WARNING_S = 8.0
_MAX_RATE = 120.0
"""[%] Top of the plot: a loop that catches up is faster for a moment."""
_MAX_TEXT = 300
_FOLDERS = re.compile(r'(?<![\w:/.])(?:/[^/\s:]+)+/(?=[^/\s])')
TISSUE = 'tissue'


class NodeState(NamedTuple):
    """One line of the table of nodes.

    Attributes:
        name: of the node.
        level: of its newest status, 0 to 3 as in diagnostic_msgs/DiagnosticStatus.
        message: of that status.
        rate: [Hz] of its loop; 0: it has none.
    """

    name: str
    level: int
    message: str
    rate: float


@dataclass(frozen=True)
class SessionState:
    """Report of the launcher on the session.

    Attributes:
        scene: name.
        method: of cutting.
        recording: name of the bag in progress, '' without one.
        busy: activity that blocks the session, '' when there is none.
        problem: why a request failed, '' when none did.
        scene_file: path, where the nodes read another scene from now on; else ''.
        attempts: list of attempts, newest first, where it has changed; else None.
        replay: number and link of the newest replay that was asked for; None: none.
        tissue: factors of the scene's own stiffness and toughness.
    """

    scene: str
    method: str
    recording: str = ''
    busy: str = ''
    problem: str = ''
    scene_file: str = ''
    attempts: list[dict[str, Any]] | None = None
    replay: tuple[int, str] | None = None
    tissue: dict[str, float] = field(default_factory=lambda: dict(OWN_TISSUE))


class LivePage:
    """Shows a session on its pages, newest state first.

    All methods are called by one thread, that of the graph.

    Args:
        server: of the pages.
        tools: to draw, the first one first.
        exercise: to show.
        controls: allowed requests at the beginning.

    Attributes:
        scored: whether the attempt at the exercise is over and has a score.
    """

    def __init__(
        self,
        server: PageServer,
        tools: Sequence[ToolSettings],
        exercise: ExerciseSettings,
        controls: LiveControls,
    ) -> None:
        self._server, self._tools, self._controls = server, tools, controls
        self._begin_exercise(exercise)
        self._source = TissueSource(TISSUE)
        self._history = History(4, _SAMPLES)
        self._gauge: SurfaceDepth | None = None
        self._next_plot = self._next_table = 0.0
        self._warning = self._busy = ''
        self._now = self._warned = 0.0
        self._notices = 0
        self._hello(None)

    @property
    def is_recording(self) -> bool:
        """Whether the launcher has a bag in progress."""
        return self._controls.recording

    def _hello(self, replica: MeshReplica | None) -> None:
        positions = None if replica is None else replica.positions()
        bounds = None if positions is None else reach(positions)
        self._allow(bounds=bounds)
        self._server.put(
            'hello',
            version=VERSION,
            mode='live',
            title=TITLE,
            session=self._controls.session,
            scenes=self._controls.scenes,
            methods=self._controls.methods,
            duration=None,
            speeds=[],
            exercises=[
                {'name': name, 'title': title} for name, title in self._controls.exercises.items()
            ],
            tool=tool_shape(self._tools[0]),
            further_tools=[tool_shape(tool) for tool in self._tools[1:]],
            camera=None if positions is None else camera(positions),
            floor=FLOOR,
            bounds=None if bounds is None else {'low': bounds.low, 'high': bounds.high},
            metres_per_newton=METRES_PER_NEWTON,
            tissues=[shown_tissue(TISSUE, '')],
            plots_span=PLOT_SPAN_S,
            exercise=shown_exercise(self._exercise),
        )

    def _allow(self, **changes: object) -> None:
        changed = replace(self._controls, **changes)  # type: ignore[arg-type]
        if changed != self._controls:
            self._controls = changed
            self._server.allow(changed)

    def equip(self, tools: Sequence[ToolSettings], exercise: ExerciseSettings) -> None:
        """Replace the drawn tools and the exercise, for another tissue."""
        self._tools, self._gauge = tools, None
        self._begin_exercise(exercise)
        self._server.put('attempt', rows=[], score=None, bridge=None)

    def _begin_exercise(self, exercise: ExerciseSettings) -> None:
        self._exercise, self.scored = exercise, False
        self._progress = AttemptProgress(exercise) if exercise.title else None

    def show(
        self,
        now: float,
        replica: MeshReplica,
        moment: Moment | None,
        rates: tuple[float, float],
        *,
        can_guide: bool,
        further: Sequence[dict[str, Any] | None] = (),
    ) -> None:
        """Show the newest state.

        Args:
            now: [s], monotonic.
            replica: of the tissue.
            moment: of the tool, None before it is known.
            rates: of force loop and tissue, as shares of their nominal ones.
            can_guide: whether the hand follows goals.
            further: as in `put_moment`.
        """
        self._now = now
        if replica.revision >= 0:
            if self._gauge is None:
                self._gauge = SurfaceDepth(replica)
                self._hello(replica)
            if (frame := self._source.frame(replica)) is not None:
                self._server.put_tissue(frame)
        self._allow(can_guide=can_guide)
        depth = force = 0.0
        if moment is not None and moment.is_finite:
            force, depth = float(np.linalg.norm(moment.force)), self._depth(moment)
            put_moment(self._server, moment, depth, can_guide=can_guide, further=further)
            self._show_progress(now, replica, moment)
        self._history.add(now, force, depth, *rates)
        if now >= self._next_plot:
            self._next_plot = now + _PLOT_PERIOD_S
            self._plot()

    def _show_progress(self, now: float, replica: MeshReplica, moment: Moment) -> None:
        if self._progress is None or replica.revision < 0:
            return
        if (content := self._progress.see(now, replica, moment)) is not None:
            self.scored = content['score'] is not None
            self._server.put('attempt', **content)

    def show_attempts(self, rows: Sequence[dict[str, Any]]) -> None:
        """Show the list of attempts, newest first."""
        self._allow(bags=tuple(row['bag'] for row in rows))
        self._server.put('attempts', rows=list(rows))

    def show_replay(self, number: int, link: str) -> None:
        """Show where the replay that was asked for is served."""
        self._server.put('replay', number=number, link=link)

    def _depth(self, moment: Moment) -> float:
        if self._gauge is None:
            return 0.0
        return float(self._gauge.depths(moment.blade[None])[0])

    def _plot(self) -> None:
        rows = self._history.rows()[::-_EVERY][::-1]
        times = rows[:, 0] - self._now
        rates = np.minimum(1e2 * rows[:, 3:], _MAX_RATE).T
        lines = (
            plots.FORCE.lines(times, rows[:, 1]),
            plots.DEPTH.lines(times, 1e3 * rows[:, 2]),
            plots.RATES.lines(times, *rates),
        )
        self._server.put('plots', span=[-PLOT_SPAN_S, 0.0], lines=lines)

    def show_state(
        self, state: str, text: str, guided: str = '', *, e_stopped: bool, held: bool
    ) -> None:
        """Show the operating state, with the last warning beside it.

        Args:
            state: of CRTK.
            text: about it.
            guided: how the pointer moves the tool.
            e_stopped: whether an E-STOP holds.
            held: whether the instructor has paused.
        """
        if self._now - self._warned > _WARNING_S:
            self._warning = ''
        said = self._busy or ' '.join(filter(None, (text, self._warning)))
        self._allow(e_stopped=e_stopped, held=held)
        self._server.put(
            'state',
            state=state,
            text=plain(said),
            guided='' if self._busy else guided,
            e_stopped=e_stopped,
            held=held,
        )

    def warn(self, text: str) -> None:
        """Show a warning for a while."""
        self._warning, self._warned = plain(text), self._now
        self._notices += 1
        self._server.put('notice', id=self._notices, text=plain(text))

    def show_nodes(self, now: float, nodes: Sequence[NodeState]) -> None:
        """Show the table of nodes at a time [s]."""
        if now >= self._next_table:
            self._next_table = now + _TABLE_PERIOD_S
            rows = [
                node._replace(message=plain(node.message), rate=round(node.rate, 1))._asdict()
                for node in nodes
            ]
            self._server.put('nodes', rows=rows)

    def show_scale(self, scale: float) -> None:
        """Show the present force scale; one beyond the range widens it."""
        low, high = min(SCALE[0], scale), max(SCALE[1], scale)
        self._allow(scale=(low, high))
        self._server.put('scale', value=scale, min=low, max=high)

    def show_session(self, state: SessionState) -> None:
        """Show the report of the launcher."""
        scene, method = state.scene[:MAX_NAME], state.method
        self._busy = state.busy
        if state.problem:
            self.warn(state.problem)
        if state.attempts is not None:
            self.show_attempts(state.attempts)
        if state.replay is not None:
            self.show_replay(*state.replay)
        scenes = self._controls.scenes
        if scene not in scenes:
            scenes = (*scenes, scene)
        recording = state.recording.rpartition('/')[2]
        self._allow(scenes=scenes, busy=state.busy, recording=bool(recording))
        self._server.put(
            'session',
            scene=scene,
            method=method,
            recording=recording,
            busy=plain(state.busy),
            scenes=scenes,
            tissue=state.tissue,
        )


def put_moment(
    server: PageServer,
    moment: Moment,
    depth: float,
    *,
    can_guide: bool,
    further: Sequence[dict[str, Any] | None] = (),
) -> None:
    """Show the pose of the tool and the force on the hand.

    Args:
        server: of the pages.
        moment: to show; a moment that is not finite is skipped.
        depth: of the blade's end [m].
        can_guide: whether the hand follows goals.
        further: tip [m] and wxyz of each further tool; None: it is not known.
    """
    if not moment.is_finite:
        return
    server.put(
        'moment',
        tip=moment.tip.tolist(),
        wxyz=moment.orientation.tolist(),
        proxy=None if moment.contact == INSIDE else moment.proxy.tolist(),
        force=moment.force.tolist(),
        depth=depth,
        can_guide=can_guide,
        contact=moment.contact,
        clutched=moment.clutched,
        further=list(further),
    )


def plain(text: str) -> str:
    """Return a text for pages: on one line, bounded in length, file names without folders."""
    shown = ''.join(c if c.isprintable() else ' ' for c in text[: 4 * _MAX_TEXT])
    return _FOLDERS.sub('', shown)[:_MAX_TEXT]
