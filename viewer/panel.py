"""The panel of the page: buttons, choices, plots, the state of every node."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, NamedTuple, get_args

import numpy as np

from cutting.settings import CuttingSettings
from haptic_bridge.operating_state import State
from viewer.history import Floats

PLOTTED = 15.0
"""[s] that the plots show."""
_DATA_WIDTH = 320
_HIGHEST_RATE = 120.0
"""[%] that the plot shows: who catches up is faster for a moment."""
METHODS: tuple[str, ...] = get_args(CuttingSettings.model_fields['method'].annotation)
_COLOURS = {
    State.ENABLED: '#2f9e44',
    State.PAUSED: '#e8890c',
    State.DISABLED: '#868e96',
    State.FAULT: '#e03131',
}
_LEVELS = ('#2f9e44', '#e8890c', '#e03131', '#868e96')
"""By level of a diagnostic status: OK, WARN, ERROR, STALE."""
_CELL = 'padding:1px 6px 1px 0;vertical-align:top'


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


@dataclass
class Actions:
    """What the buttons do.

    Attributes:
        start, pause, e_stop, reset: take nothing.
        record: whether to record from now on.
        choose: scene and cutting method.
        scale: hand force over tissue force.
    """

    start: Callable[[], None]
    pause: Callable[[], None]
    e_stop: Callable[[], None]
    reset: Callable[[], None]
    record: Callable[[bool], None]
    choose: Callable[[str, str], None]
    scale: Callable[[float], None]


class Panel:
    """The controls of a live session.

    Args:
        server: of the page.
        actions: of the buttons.
        scenes: that can be chosen.
        session: whether there is a launcher that can reset, record and choose.
    """

    def __init__(
        self, server: Any, actions: Actions, scenes: Sequence[str], *, session: bool
    ) -> None:
        gui = server.gui
        self._actions = actions
        self._recording = False
        # First of all: no text above it that could grow and move it away from under the mouse.
        stop = gui.add_button('E-STOP', color='red', hint='No force at once, until Start')
        self._state = gui.add_html(state_html('', ''))
        buttons = {
            'Start': (actions.start, 'Let the force in: after a pause, a stop, a fault'),
            'Pause': (actions.pause, 'No force; the hand stands still'),
        }
        for label, (action, hint) in buttons.items():
            gui.add_button(label, hint=hint).on_click(_async(action))
        self._reset = gui.add_button('Reset', hint='The whole tissue again', disabled=not session)
        self._record = gui.add_button('Record', color='gray', disabled=not session)
        # In the server's own loop, at once: no queue of threads between a click and the force.
        stop.on_click(_async(actions.e_stop))
        self._reset.on_click(_async(actions.reset))
        self._record.on_click(_async(lambda: actions.record(not self._recording)))
        with gui.add_folder('Session'):
            self._scene = gui.add_dropdown('Scene', tuple(scenes), disabled=not session)
            self._method = gui.add_dropdown('Cutting', METHODS, disabled=not session)
            self._scale = gui.add_slider('Force scale', 0.1, 3.0, 0.1, 1.0)
        self._scene.on_update(self._chosen)
        self._method.on_update(self._chosen)
        self._scale.on_update(self._scaled)
        data = gui.add_panel()
        with data.add_tab('Plots and nodes'):
            self.plots = Plots(gui)
            self._nodes = gui.add_html('')
        data.dock_left()
        data.set_width(_DATA_WIDTH)

    def _chosen(self, event: Any) -> None:
        if event.client is not None:
            self._actions.choose(self._scene.value, self._method.value)

    def _scaled(self, event: Any) -> None:
        if event.client is not None:
            self._actions.scale(self._scale.value)

    def show_state(self, state: str, text: str) -> None:
        """Shows an operating state and what is to be said about it."""
        self._state.content = state_html(state, text)

    def show_nodes(self, nodes: Sequence[NodeState]) -> None:
        """Shows the table of nodes."""
        self._nodes.content = nodes_html(nodes)

    def show_session(self, scene: str, method: str, recording: str, *, busy: bool) -> None:
        """Shows what the launcher says.

        Args:
            scene: that runs.
            method: of cutting.
            recording: folder of the bag, '' where none is made.
            busy: it is restarting nodes: nothing can be asked for.
        """
        self._recording = bool(recording)
        self._record.label = 'Stop recording' if recording else 'Record'
        self._record.color = 'red' if recording else 'gray'
        if scene not in self._scene.options:
            self._scene.options = (*self._scene.options, scene)
        self._scene.value, self._method.value = scene, method
        for control in (self._reset, self._record, self._scene, self._method):
            control.disabled = busy

    def show_scale(self, scale: float) -> None:
        """Shows the force scale that holds; one beyond the slider's ends moves them."""
        slider = self._scale
        slider.min, slider.max = min(slider.min, scale), max(slider.max, scale)
        slider.value = scale


class Plots:
    """Force, depth and rates over the last seconds.

    Args:
        gui: of the page, inside what holds the plots.
    """

    def __init__(self, gui: Any) -> None:
        self._force = TimePlot(gui, 'Force on the hand [N]', {'force': '#1c7ed6'}, 0.5)
        self._depth = TimePlot(gui, 'Depth of the blade [mm]', {'depth': '#c2255c'}, 5.0)
        rates = {'force loop': '#1c7ed6', 'tissue': '#e8590c'}
        self._rates = TimePlot(gui, 'Rates [% of nominal]', rates, _HIGHEST_RATE)

    def show(self, rows: Floats) -> None:
        """Shows a history.

        Args:
            rows: time [s], force [N], depth [m], force loop and tissue [1], shape (n, 5).
        """
        if len(rows) < 2:
            return
        time = rows[:, 0] - rows[-1, 0]
        self._force.show(time, rows[:, 1])
        self._depth.show(time, 1e3 * rows[:, 2])
        self._rates.show(time, *np.minimum(1e2 * rows[:, 3:], _HIGHEST_RATE).T)


class TimePlot:
    """Lines over time, from zero to a top that grows in steps.

    Args:
        gui: of the page.
        title: with the unit.
        lines: colour by name.
        least: smallest top.
        span: of the time [s].
    """

    def __init__(
        self,
        gui: Any,
        title: str,
        lines: Mapping[str, str],
        least: float,
        span: tuple[float, float] = (-PLOTTED, 0.0),
    ) -> None:
        self._least, self._top, self._span = least, 0.0, span
        series: list[dict[str, Any]] = [{'label': 't [s]'}]
        series += [
            {'label': name, 'stroke': colour, 'width': 2, 'points': {'show': False}}
            for name, colour in lines.items()
        ]
        self._plot = gui.add_uplot(
            tuple(np.zeros(2) for _ in series),
            tuple(series),
            title=title,
            legend={'show': len(lines) > 1, 'live': False},
            cursor={'show': False},
            height=130 if len(lines) == 1 else 160,
        )

    def show(self, time: Floats, *lines: Floats, mark: Floats | None = None) -> None:
        """Draws the lines; a mark stands beside them without a say in the scale."""
        wanted = max(self._least, *(float(line.max()) for line in lines))
        top = self._least * 2.0 ** np.ceil(np.log2(wanted / self._least))
        if top != self._top:
            self._top = top
            time_axis = {'time': False, 'range': self._span}
            self._plot.scales = {'x': time_axis, 'y': {'range': (0.0, top)}}
        self._plot.data = (time, *lines) if mark is None else (time, *lines, mark)


def _async(action: Callable[[], None]) -> Any:
    async def clicked(_: Any) -> None:
        action()

    return clicked


def state_html(state: str, text: str) -> str:
    """The operating state as a coloured line with a sentence below."""
    colour = _COLOURS.get(State(state), '#868e96') if state else '#868e96'
    shown = escape(state or 'waiting for the haptic bridge')
    return (
        f'<div style="margin:6px 10px;font-size:14px"><div style="background:{colour};color:white;'
        f'border-radius:6px;padding:6px 10px;font-weight:700">{shown}</div>'
        '<div style="padding:5px 2px;height:4.6em;overflow:auto;color:#495057">'
        f'{escape(text)}</div></div>'
    )


def nodes_html(nodes: Sequence[NodeState]) -> str:
    """The table of nodes."""
    rows = ''.join(
        f'<tr><td style="{_CELL};color:{_LEVELS[min(node.level, 3)]}">&#9679;</td>'
        f'<td style="{_CELL};font-weight:600">{escape(node.name)}</td>'
        f'<td style="{_CELL};text-align:right">{f"{node.rate:.0f} Hz" if node.rate else ""}</td>'
        f'<td style="{_CELL}">{escape(node.message)}</td></tr>'
        for node in nodes
    )
    return f'<table style="margin:4px 10px;font-size:12px;border-spacing:0">{rows}</table>'
