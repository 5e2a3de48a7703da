"""The page of a recorded session: a time line, and a computed tissue beside the recorded one."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bags.player import Playhead, duration
from bags.reader import Bag
from haptic_bridge.settings import DeviceSettings, ToolSettings
from tissue_sim.depth import DepthGauge
from viewer.moment import Floats, Translator
from viewer.page import open_page
from viewer.panel import TimePlot
from viewer.stage import OTHER_TISSUE, Stage, TissueView
from viewer.tracks import ComputedTissue, RecordedTissue, RecordedTool

RATE = 30.0
"""Updates of the page [Hz], at most."""
_RATES = {'0.1 x': 0.1, '0.25 x': 0.25, '0.5 x': 0.5, '1 x': 1.0, '2 x': 2.0, '4 x': 4.0}
_PLOTTED = 1000
"""Points of a plot."""
_PLOT_PERIOD = 0.2


class ReplayPage:
    """Shows a bag.

    Args:
        bag: to read.
        tool, device: sections of its scene.
        computed: a tissue to stand beside the recorded one; None: none.
        name: of that one.
        host, port: where the page is served.

    Raises:
        BagError: the bag has no tissue.
        PageError: the page cannot be served there.
    """

    def __init__(
        self,
        bag: Bag,
        tool: ToolSettings,
        device: DeviceSettings,
        computed: ComputedTissue | None,
        name: str,
        host: str,
        port: int,
    ) -> None:
        self._recorded, self._tool = RecordedTissue(bag), RecordedTool(bag)
        self._computed, self._translator = computed, Translator(device)
        self._end = duration(bag)
        self._playhead = Playhead(0.0, self._end)
        self.server = server = open_page(host, port)
        self._stage = Stage(server, tool)
        first = self._recorded.go_to(0.0)
        self._stage.look_at(first, beside=computed is not None)
        self._tissue = TissueView(server, '/tissue')
        self._beside: TissueView | None = None
        if computed is not None:
            self._put_beside(first.positions(), name)
        self._depths = DepthGauge(first).depths(self._tool.contact.vectors('blade_tip'))
        self._shown = -1.0
        self._next_plot = 0.0
        self._add_controls(name)

    def _put_beside(self, positions: Floats, name: str) -> None:
        """A place for the computed tissue, to the right of the recorded one."""
        width = float(np.ptp(positions[:, 0]))
        offset = (1.25 * width, 0.0, 0.0)
        scene = self.server.scene
        self._beside = TissueView(self.server, '/computed', OTHER_TISSUE, offset)
        low, middle = positions.min(axis=0), positions.mean(axis=0)
        for place, text in ((0.0, 'recorded'), (offset[0], name)):
            spot = (middle[0] + place, low[1] - 0.15 * width, low[2])
            scene.add_label(f'/label/{text}', text, position=spot)

    def _add_controls(self, name: str) -> None:
        gui = self.server.gui
        self._button = gui.add_button('Play')
        self._slider = gui.add_slider('Time [s]', 0.0, round(self._end, 2), 0.01, 0.0)
        self._rate = gui.add_dropdown('Speed', tuple(_RATES), initial_value='1 x')
        self._button.on_click(self._toggle)
        self._slider.on_update(self._seek)
        self._rate.on_update(self._change_rate)
        panel = gui.add_panel()
        tissue = {'recorded': '#1c7ed6'} | ({name: '#e8590c'} if self._computed else {})
        self._plots: list[tuple[TimePlot, Floats, list[Floats]]] = []
        times = np.linspace(0.0, self._end, _PLOTTED)
        with panel.add_tab('Plots'):
            for title, lines, values, least in (
                ('Force on the hand [N]', {'recorded': '#1c7ed6'}, [self._hand()], 0.5),
                ('Force of the tissue [N]', tissue, self._forces(), 0.5),
                ('Depth of the blade [mm]', {'recorded': '#c2255c'}, [self._depth()], 5.0),
            ):
                plot = TimePlot(gui, title, {**lines, 'now': '#212529'}, least, (0.0, self._end))
                rows = [_resampled(times, *value) for value in values]
                self._plots.append((plot, times, rows))
        panel.dock_left()
        panel.set_width(320)

    def _hand(self) -> tuple[Floats, Floats]:
        wrench = self._tool.wrench
        return wrench.times, np.linalg.norm(wrench.vectors('force'), axis=1)

    def _depth(self) -> tuple[Floats, Floats]:
        return self._tool.contact.times, 1e3 * self._depths

    def _forces(self) -> list[tuple[Floats, Floats]]:
        force = self._tool.force
        rows = [(force.times, np.linalg.norm(force.vectors('force'), axis=1))]
        if self._computed is not None:
            rows.append((np.array(self._computed.times), np.array(self._computed.forces)))
        return rows

    async def _toggle(self, _: Any) -> None:
        if self._playhead.over:
            self._playhead.seek(0.0)
        self._playhead.toggle()

    async def _seek(self, event: Any) -> None:
        if event.client is not None:
            self._playhead.seek(float(self._slider.value))

    def seek(self, position: float) -> None:
        """Goes to a position [s], with the time line."""
        self._playhead.seek(position)
        self._slider.value = round(self._playhead.position, 2)

    async def _change_rate(self, _: Any) -> None:
        self._playhead.rate = _RATES[self._rate.value]

    def run(self, stop: Callable[[], bool]) -> None:
        """Serves the page until `stop` says so."""
        while not stop():
            began = time.monotonic()
            self.show(self._playhead.move(began), began)
            time.sleep(max(0.0, began + 1 / RATE - time.monotonic()))

    def show(self, position: float, now: float) -> None:
        """Shows the session at a position [s], at a time of the caller's clock [s]."""
        if self._playhead.over and not self._playhead.paused:
            self._playhead.toggle()
        self._button.label = 'Play' if self._playhead.paused else 'Pause'
        if position != self._shown:
            self._shown = position
            self._tissue.show(self._recorded.go_to(position))
            if self._beside is not None and self._computed is not None:
                self._beside.show(self._computed.go_to(position))
            contact = self._tool.contact.at(position)
            if contact is not None:
                pose, wrench = self._tool.pose.at(position), self._tool.wrench.at(position)
                self._stage.show(self._translator.moment(contact, pose, wrench))
            if not self._playhead.paused:
                self._slider.value = round(position, 2)
        if now >= self._next_plot:
            self._next_plot = now + _PLOT_PERIOD
            for plot, times, rows in self._plots:
                reached = np.where(np.abs(times - position) <= self._end / _PLOTTED / 2, 1e9, 0.0)
                plot.show(times, *rows, mark=reached)


def _resampled(times: Floats, known: Floats, values: Floats) -> Floats:
    """Values at other times: the last one before each, and 0 before the first."""
    at = np.searchsorted(known, times, 'right') - 1
    return np.where(at >= 0, values[np.maximum(at, 0)], 0.0) if len(known) else 0.0 * times
