"""The page of a live session: what is drawn how often, and the handles that move the blade."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from haptic_bridge.settings import ToolSettings
from tissue_sim.depth import DepthGauge
from tissue_sim.replica import MeshReplica
from viewer.history import History
from viewer.moment import Floats, Moment
from viewer.panel import PLOTTED, Actions, NodeState, Panel
from viewer.stage import Stage, TissueView

_PLOT_PERIOD, _TABLE_PERIOD = 0.2, 0.5
_SAMPLES = round(PLOTTED * 30)
_HANDLES = 0.035
"""[m] size of the handles at the blade."""


@dataclass(frozen=True)
class SessionState:
    """What the launcher says of the session.

    Attributes:
        scene: name.
        method: of cutting.
        recording: folder of the bag that is being made, '' without one.
        busy: what it is doing and has to be waited for, '' when nothing.
        problem: why something could not be done, '' when nothing.
        scene_file: path, where the nodes read another one from now on; else ''.
    """

    scene: str
    method: str
    recording: str = ''
    busy: str = ''
    problem: str = ''
    scene_file: str = ''


class LivePage:
    """Draws a session on a page, newest state first: what comes in between is never drawn.

    Args:
        server: of the page.
        tool: as it is drawn.
        actions: of the buttons.
        scenes: to choose from.
        guide: takes the position [m] and the quaternion w x y z to which the blade is dragged.
        session: whether there is a launcher behind it.
    """

    def __init__(
        self,
        server: Any,
        tool: ToolSettings,
        actions: Actions,
        scenes: Sequence[str],
        guide: Callable[[Floats, Floats], None],
        *,
        session: bool,
    ) -> None:
        self._server = server
        self.panel = Panel(server, actions, scenes, session=session)
        self._stage = Stage(server, tool)
        self._tissue = TissueView(server, '/tissue')
        self._guide = guide
        self._handles = server.scene.add_transform_controls(
            '/handles', scale=_HANDLES, visible=False, depth_test=False, line_width=3.0
        )
        self._handles.on_update(self._dragged)
        self._guided = False
        self._history = History(4, _SAMPLES)
        self._gauge: DepthGauge | None = None
        self._next_plot = self._next_table = 0.0
        self._said = ('', '')
        self._warning = self._busy = ''
        self._now = self._warned = 0.0

    def equip(self, tool: ToolSettings) -> None:
        """Draws another tool, for another tissue."""
        self._stage.equip(tool)
        self._gauge = None

    async def _dragged(self, _: Any) -> None:
        self._guided = True  # from now on the handles show where the hand wants to be
        self._guide(self._handles.position, self._handles.wxyz)

    def show(
        self,
        now: float,
        replica: MeshReplica,
        moment: Moment | None,
        rates: tuple[float, float],
        *,
        can_guide: bool,
    ) -> None:
        """Draws the newest state.

        Args:
            now: [s], monotonic.
            replica: of the tissue.
            moment: of the tool, None before it is known.
            rates: of force loop and tissue, as shares of their nominal ones.
            can_guide: whether a hand would follow the handles.
        """
        self._now = now
        if replica.revision >= 0:
            if self._gauge is None:
                self._measure(replica)
            self._tissue.show(replica)
        depth = force = 0.0
        if moment is not None:
            force = float((moment.force @ moment.force) ** 0.5)
            depth = self._depth(moment)
            self._stage.show(moment)
            self._handles.visible = can_guide
            if not self._guided:
                self._handles.position, self._handles.wxyz = moment.tip, moment.turn
        self._history.add(now, force, depth, *rates)
        if now >= self._next_plot:
            self._next_plot = now + _PLOT_PERIOD
            self.panel.plots.show(self._history.rows())

    def _measure(self, replica: MeshReplica) -> None:
        self._gauge = DepthGauge(replica)
        self._stage.look_at(replica)

    def _depth(self, moment: Moment) -> float:
        if self._gauge is None:
            return 0.0
        return float(self._gauge.depths(moment.blade[1:])[0])

    def show_state(self, state: str, text: str) -> None:
        """Shows the operating state; a warning of late stands beside it."""
        if self._now - self._warned > 8.0:
            self._warning = ''
        said = (state, self._busy or ' '.join(filter(None, (text, self._warning))))
        if said != self._said:
            self._said = said
            self.panel.show_state(*said)

    def warn(self, text: str) -> None:
        """Shows a warning for a while."""
        self._warning, self._warned = text, self._now

    def show_nodes(self, now: float, nodes: Sequence[NodeState]) -> None:
        """Shows the table of nodes."""
        if now >= self._next_table:
            self._next_table = now + _TABLE_PERIOD
            self.panel.show_nodes(nodes)

    def show_scale(self, scale: float) -> None:
        """Shows the force scale that holds."""
        self.panel.show_scale(scale)

    def show_session(self, state: SessionState) -> None:
        """Shows what the launcher says."""
        self._guided &= not state.busy
        self._busy = state.busy
        if state.problem:
            self.warn(state.problem)
        self.panel.show_session(state.scene, state.method, state.recording, busy=bool(state.busy))
