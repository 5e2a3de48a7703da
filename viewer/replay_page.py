"""Page of a recorded session: time line, and another tissue beside the recorded one."""

import time
from collections.abc import Callable

import numpy as np

from cutting_trainer.bags.playback_control import Playhead
from cutting_trainer.viewer.access_control import Gate
from cutting_trainer.viewer.allowed_requests import ReplayControls
from cutting_trainer.viewer.appearance import (
    FLOOR,
    METRES_PER_NEWTON,
    OTHER_TISSUE,
    TISSUE,
    TISSUE_SPACING,
    camera,
    shown_exercise,
    shown_tissue,
    tool_shape,
)
from cutting_trainer.viewer.drawn_surface import TissueSource
from cutting_trainer.viewer.live_page import put_moment
from cutting_trainer.viewer.page_protocol import VERSION, AnyMessage, Play, Seek, Speed
from cutting_trainer.viewer.page_server import PageServer
from cutting_trainer.viewer.pending_requests import Requests
from cutting_trainer.viewer.plots import BLUE, DEPTH, FORCE, ORANGE, Plot
from cutting_trainer.viewer.recording import Beside, Recording
from cutting_trainer.viewer.tool_state import Floats, drawn

RATE_HZ = 30.0
"""[Hz] Largest update rate of the page."""
SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
RECORDED, BESIDE = 'tissue', 'beside'
"""Names of the tissues on the page."""
_PLOT_POINTS = 1000
"""Number of points of a plot."""


class ReplayPage:
    """Shows a recorded session.

    Args:
        recording: to show.
        beside: shown beside it; None: nothing.
        host, port: address of the page.
        gate: access rules.

    Attributes:
        end: of the session, or of both [s].

    Raises:
        PageError: the page cannot be served at this address.
    """

    def __init__(
        self, recording: Recording, beside: Beside | None, host: str, port: int, gate: Gate
    ) -> None:
        self._recording, self._beside = recording, beside
        self._sources = TissueSource(RECORDED), TissueSource(BESIDE)
        self.end = max(recording.end, beside.end if beside else 0.0)
        self._playhead = Playhead(0.0, self.end)
        positions = recording.tissue.go_to(0.0).positions()
        self._apart = np.array([TISSUE_SPACING * float(np.ptp(positions[:, 0])), 0.0, 0.0])
        self._shown = -1.0
        self._asked = Requests()
        controls = ReplayControls(self.end, SPEEDS)
        self.server = PageServer(host, port, gate, 'replay', controls, self._ask)
        self._hello(positions)
        self._plot()

    def _hello(self, positions: Floats) -> None:
        recording, beside = self._recording, self._beside
        named, tools = '', []
        tissues, seen = [], [positions]
        if beside is not None:
            named = 'recorded' if beside.recording is None else recording.name
            colour = OTHER_TISSUE if beside.recording is None else TISSUE
            tissues.append(shown_tissue(BESIDE, beside.name, colour, float(self._apart[0])))
            seen.append(positions + self._apart)
            if beside.recording is not None:
                tools.append(tool_shape(beside.recording.tool))
        self.server.put(
            'hello',
            version=VERSION,
            mode='replay',
            title='Recorded session',
            session=False,
            scenes=[],
            methods=[],
            exercises=[],
            duration=self.end,
            speeds=SPEEDS,
            tool=tool_shape(recording.tool),
            further_tools=tools,
            camera=camera(np.concatenate(seen)),
            floor=FLOOR,
            bounds=None,
            metres_per_newton=METRES_PER_NEWTON,
            tissues=[shown_tissue(RECORDED, named), *tissues],
            plots_span=self.end,
            exercise=shown_exercise(recording.exercise),
        )

    def _plot(self) -> None:
        recording, beside = self._recording, self._beside
        wrench = recording.track.wrench
        times = np.linspace(0.0, self.end, _PLOT_POINTS)
        hand = np.linalg.norm(wrench.vectors('force'), axis=1)
        colours = {'recorded': BLUE}
        felt = [resampled(times, *recording.felt)]
        if beside is not None:
            colours = {'recorded' if beside.recording is None else 'left': BLUE}
            colours[beside.name if beside.recording is None else 'right'] = ORANGE
            felt.append(resampled(times, *beside.felt))
        depths = 1e3 * recording.depths
        lines = (
            FORCE.lines(times, resampled(times, wrench.times, hand)),
            Plot('Force of the tissue', 'N', colours, 0.5).lines(times, *felt),
            DEPTH.lines(times, resampled(times, recording.track.contact.times, depths)),
        )
        self.server.put('plots', span=[0.0, self.end], lines=lines)

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
            self._show_tools(position)
        self.server.put(
            'playhead',
            time=round(position, 3),
            playing=not playhead.paused,
            speed=playhead.rate,
        )

    def _show_tissues(self, position: float) -> None:
        tissues = [self._recording.tissue.go_to(position)]
        if self._beside is not None:
            tissues.append(self._beside.tissue.go_to(position + self._beside.later))
        for source, tissue in zip(self._sources, tissues, strict=False):
            if (frame := source.frame(tissue)) is not None:
                self.server.put_tissue(frame)

    def _show_tools(self, position: float) -> None:
        moment, further = self._recording.moment(position), []
        if self._beside is not None and self._beside.recording is not None:
            other = self._beside.recording.moment(position + self._beside.later)
            if other is not None:
                other = other._replace(tip=other.tip + self._apart)
            further.append(drawn(other))
        if moment is not None:
            depth = self._recording.depth(position)
            put_moment(self.server, moment, depth, further=further, can_guide=False)


def resampled(times: Floats, known: Floats, values: Floats) -> Floats:
    """Return values at other times: the last one before each, and 0 before the first.

    Args:
        times: requested times [s], shape (n,).
        known: times of the values [s], ascending, shape (k,).
        values: shape (k,).
    """
    at = np.searchsorted(known, times, 'right') - 1
    return np.where(at >= 0, values[np.maximum(at, 0)], 0.0) if len(known) else 0.0 * times
