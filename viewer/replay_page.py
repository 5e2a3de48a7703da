"""Page of a recorded session: time line, and a computed tissue beside the recorded one."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from cutting_trainer.bags.playback_control import Playhead
from cutting_trainer.bags.playback_messages import duration
from cutting_trainer.bags.reader import Bag
from cutting_trainer.bags.recorded_indexings import indexing_at
from cutting_trainer.exercises.scene_schema import ExerciseSettings
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, ToolSettings
from cutting_trainer.tissue_sim.mesh.depth import SurfaceDepth
from cutting_trainer.viewer.access_control import Gate
from cutting_trainer.viewer.allowed_requests import ReplayControls
from cutting_trainer.viewer.appearance import (
    FLOOR,
    METRES_PER_NEWTON,
    TISSUE_SPACING,
    camera,
    shown_exercise,
    shown_tissue,
    tool_shape,
)
from cutting_trainer.viewer.bag_timeline import ComputedTissue, RecordedTissue, RecordedTool
from cutting_trainer.viewer.colours import OTHER_TISSUE
from cutting_trainer.viewer.drawn_surface import TissueSource
from cutting_trainer.viewer.live_page import put_moment
from cutting_trainer.viewer.page_protocol import VERSION, AnyMessage, Play, Seek, Speed
from cutting_trainer.viewer.page_server import PageServer
from cutting_trainer.viewer.pending_requests import Requests
from cutting_trainer.viewer.plots import BLUE, DEPTH, FORCE, ORANGE, Plot
from cutting_trainer.viewer.tool_state import Floats, Translator

RATE_HZ = 30.0
"""[Hz] Largest update rate of the page."""
SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
RECORDED, COMPUTED = 'tissue', 'computed'
"""Names of the tissues on the page."""
_PLOT_POINTS = 1000
"""Number of points of a plot."""


class ReplayPage:
    """Shows a bag.

    Args:
        bag: to read.
        tool, device, exercise: sections of its scene.
        computed: a tissue to show beside the recorded one; None: none.
        name: of the computed tissue.
        host, port: address of the page.
        gate: access rules.

    Raises:
        BagError: the bag has no tissue.
        PageError: the page cannot be served at this address.
    """

    def __init__(
        self,
        bag: Bag,
        tool: ToolSettings,
        device: DeviceSettings,
        exercise: ExerciseSettings,
        computed: ComputedTissue | None,
        name: str,
        host: str,
        port: int,
        gate: Gate,
    ) -> None:
        self._recorded, self._track = RecordedTissue(bag), RecordedTool(bag)
        self._computed, self._translator = computed, Translator(device)
        self._sources = TissueSource(RECORDED), TissueSource(COMPUTED)
        self._end = duration(bag)
        self._playhead = Playhead(0.0, self._end)
        first = self._recorded.go_to(0.0)
        tips = self._track.contact.vectors('blade_tip')
        self._depths = SurfaceDepth(first).depths(tips)
        self._shown = -1.0
        self._asked = Requests()
        controls = ReplayControls(self._end, SPEEDS)
        self.server = PageServer(host, port, gate, 'replay', controls, self._ask)
        self._hello(first.positions(), tool, exercise, name)
        self._plot(name)

    def _hello(
        self, positions: Floats, tool: ToolSettings, exercise: ExerciseSettings, name: str
    ) -> None:
        apart = TISSUE_SPACING * float(np.ptp(positions[:, 0]))
        tissues = [shown_tissue(RECORDED, 'recorded' if self._computed else '')]
        seen = [positions]
        if self._computed is not None:
            tissues.append(shown_tissue(COMPUTED, name, OTHER_TISSUE, apart))
            seen.append(positions + np.array([apart, 0.0, 0.0]))
        self.server.put(
            'hello',
            version=VERSION,
            mode='replay',
            title='Recorded session',
            session=False,
            scenes=[],
            methods=[],
            duration=self._end,
            speeds=SPEEDS,
            tool=tool_shape(tool),
            camera=camera(np.concatenate(seen)),
            floor=FLOOR,
            bounds=None,
            metres_per_newton=METRES_PER_NEWTON,
            tissues=tissues,
            plots_span=self._end,
            exercise=shown_exercise(exercise),
        )

    def _plot(self, name: str) -> None:
        wrench, force = self._track.wrench, self._track.force
        times = np.linspace(0.0, self._end, _PLOT_POINTS)
        hand = np.linalg.norm(wrench.vectors('force'), axis=1)
        colours = {'recorded': BLUE}
        felt = [resampled(times, force.times, np.linalg.norm(force.vectors('force'), axis=1))]
        if self._computed is not None:
            colours[name] = ORANGE
            known = np.array(self._computed.times), np.array(self._computed.forces)
            felt.append(resampled(times, *known))
        depths = 1e3 * self._depths
        lines = (
            FORCE.lines(times, resampled(times, wrench.times, hand)),
            Plot('Force of the tissue', 'N', colours, 0.5).lines(times, *felt),
            DEPTH.lines(times, resampled(times, self._track.contact.times, depths)),
        )
        self.server.put('plots', span=[0.0, self._end], lines=lines)

    def _ask(self, message: AnyMessage) -> None:
        """Queue a request of a page, in the server's thread; the next update executes it."""
        self._asked.put(message)

    def _do(self, message: AnyMessage) -> None:
        playhead = self._playhead
        if isinstance(message, Play):
            if message.on and playhead.over:
                playhead.seek(0.0)
            playhead.paused = not message.on
        elif isinstance(message, Seek):
            playhead.seek(message.time)
        elif isinstance(message, Speed):
            playhead.rate = message.value

    def seek(self, position: float) -> None:
        """Go to a position [s]."""
        self._playhead.seek(position)

    def run(self, stop: Callable[[], bool]) -> None:
        """Serve the page until `stop` returns True."""
        while not stop():
            began = time.monotonic()
            self.update(began)
            time.sleep(max(0.0, began + 1 / RATE_HZ - time.monotonic()))

    def update(self, now: float) -> None:
        """Execute the requests of pages, and show the session at a time of the clock [s]."""
        self.server.tick()
        for message in self._asked.taken():
            self._do(message)
        self.show(self._playhead.move(now))

    def show(self, position: float) -> None:
        """Show the session at a position [s]."""
        playhead = self._playhead
        if playhead.over and not playhead.paused:
            playhead.toggle()
        if position != self._shown:
            self._shown = position
            self._show_tissues(position)
            contact = self._track.contact.at(position)
            if contact is not None:
                pose, wrench = self._track.pose.at(position), self._track.wrench.at(position)
                indexing = indexing_at(self._track.indexings, contact.stamp_ns)
                moment = self._translator.moment(contact, pose, wrench, indexing)
                put_moment(self.server, moment, self._depth(position), can_guide=False)
        self.server.put(
            'playhead',
            time=round(position, 3),
            playing=not playhead.paused,
            speed=playhead.rate,
        )

    def _show_tissues(self, position: float) -> None:
        tissues: list[Any] = [self._recorded.go_to(position)]
        if self._computed is not None:
            tissues.append(self._computed.go_to(position))
        for source, tissue in zip(self._sources, tissues, strict=False):
            if (frame := source.frame(tissue)) is not None:
                self.server.put_tissue(frame)

    def _depth(self, position: float) -> float:
        at = int(np.searchsorted(self._track.contact.times, position, 'right')) - 1
        return float(self._depths[max(at, 0)])


def resampled(times: Floats, known: Floats, values: Floats) -> Floats:
    """Return values at other times: the last one before each, and 0 before the first.

    Args:
        times: requested times [s], shape (n,).
        known: times of the values [s], ascending, shape (k,).
        values: shape (k,).
    """
    at = np.searchsorted(known, times, 'right') - 1
    return np.where(at >= 0, values[np.maximum(at, 0)], 0.0) if len(known) else 0.0 * times
