"""Node `viewer`: a web page that shows and operates a running session."""

import json
import math
import os
import queue
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np
from cutting_trainer_msgs.msg import Contact, ForceSample
from cutting_trainer_msgs.msg import Indexing as IndexingMessage
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from visualization_msgs.msg import MarkerArray

from cutting_trainer.exercises.scene_schema import ExerciseSettings, exercise_titles
from cutting_trainer.haptic_bridge.indexing import Indexing
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, HapticsSettings, ToolSettings
from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.cdr_codec import ContactCodec, PoseStampedCodec, WrenchStampedCodec
from cutting_trainer.node_common.lifecycle import ManagedNode, Stop, announce_ready, run
from cutting_trainer.node_common.operating_state import CrtkState
from cutting_trainer.node_common.output import announce
from cutting_trainer.node_common.parameters import parameter, scene_parameter
from cutting_trainer.node_common.scene_reader import read_section, tool_names
from cutting_trainer.node_common.share_folder import scene_names
from cutting_trainer.node_common.timing import PeriodicLoop
from cutting_trainer.tissue_sim.scene_schema import TissueSettings
from cutting_trainer.tissue_sim.streaming.mesh_follower import MeshFollower
from cutting_trainer.tissue_sim.streaming.reset_client import ResetClient
from cutting_trainer.viewer.access_control import (
    INSTRUCTOR_VARIABLE,
    TOKEN_VARIABLE,
    is_local,
    link,
    make_gate,
)
from cutting_trainer.viewer.allowed_requests import HELD, LiveControls
from cutting_trainer.viewer.diagnostics_table import Statuses
from cutting_trainer.viewer.further_tools import FurtherTool, further_tools
from cutting_trainer.viewer.live_page import METHODS, LivePage, SessionState
from cutting_trainer.viewer.markers import Colouring, Markers
from cutting_trainer.viewer.operator_commands import BRIDGE, Operation
from cutting_trainer.viewer.page_protocol import (
    AnyMessage,
    Attempt,
    Choose,
    EStop,
    Guide,
    Hold,
    Pause,
    Record,
    Reset,
    ResetEStop,
    Scale,
    SetTissue,
    Start,
    Watch,
)
from cutting_trainer.viewer.page_server import PageServer
from cutting_trainer.viewer.pending_requests import Requests, taken
from cutting_trainer.viewer.ring_buffers import StreamRate
from cutting_trainer.viewer.tf_frames import StaticFrames
from cutting_trainer.viewer.tool_state import Moment, Translator, drawn
from cutting_trainer.viewer.topic_rate import Stream

MARKER_PERIOD_S = 0.1
"""[s] between two marker messages."""
RATE_HZ = 30.0
"""[Hz] Largest update rate of the page."""
_NICENESS = 10
RECORDER = 'recorder'
OPEN_LINK_WARNING = (
    '(whoever has this link and reaches this machine can operate the session, and nothing is '
    'encrypted: across a network use a tunnel with TLS or ssh)'
)


class ViewerNode(ManagedNode):
    """Shows the graph and operates it; see docs/view.md.

    Parameters:
        scene: path of the scene file.
        host, port: address of the page; port 0: one that is free.
        allow_host: names of the page's server in requests, separated by commas.
        marker_colour: of the tissue in `viewer/markers`: displacement or von_mises.
        marker_largest: value of the last colour [m] or [Pa]; 0: 0.01 m, or a tenth of Young's
            modulus.
        session: a launcher reads `message: ...` on standard output and answers on standard input,
            so that it can restart the nodes and record.
    """

    def __init__(self) -> None:
        super().__init__('viewer')
        self._listener: threading.Thread | None = None

    def configure(self) -> None:
        """Read the scene, open the page and create the topics."""
        scene = Path(scene_parameter(self))
        self._colouring = self._marker_colours()
        text = 'a launcher reads standard output and answers on standard input'
        self._launched = bool(parameter(self, 'session', False, text))
        self._further: list[FurtherTool] = []
        self._take_scene(scene)
        self._follower = MeshFollower(self, self.rejections)
        self._contact = Stream(self, Contact, ros.CONTACT, ContactCodec())
        self._wrench = Stream(self, WrenchStamped, self._force_topic, WrenchStampedCodec())
        self._pose = Stream(self, PoseStamped, f'{ros.ARM}/measured_cp', PoseStampedCodec())
        self._indexing: Indexing | None = None
        ros.listen(self, IndexingMessage, ros.INDEXING, self._take_indexing, qos.LATCHED)
        self._reactions = StreamRate()
        self._samples = ros.polled(self, ForceSample, ros.FORCE, qos.NEWEST_BEST_EFFORT)
        self._marker_array = self.create_publisher(MarkerArray, ros.MARKERS, qos.EVENTS)
        text = 'publish the frames of the device on tf_static; false: another node owns them'
        publish = bool(parameter(self, 'publish_frames', True, text))
        self._frames = StaticFrames(self, self._device, publish=publish)
        self._statuses = Statuses(self.get_namespace())
        ros.listen(self, DiagnosticArray, ros.DIAGNOSTICS, self._statuses.take, qos.EVENTS)
        # Calls from other threads for the one that updates the page, at its next iteration.
        self._asked = Requests()
        self._calls: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()

        def warn(text: str) -> None:
            self._calls.put(lambda: self._page.warn(text))

        self._operation = Operation(self, warn, tool_names(scene))
        self._held = False  # by the instructor; set in the server's thread alone
        self._open_page()
        self._resetter = ResetClient(self, warn)
        self._scored = False
        self._loop = PeriodicLoop(RATE_HZ)
        self._next_markers = 0.0
        self._diagnostics = ros.Diagnostics(self, self._status)

    def _open_page(self) -> None:
        host = str(parameter(self, 'host', '127.0.0.1', 'address of the page'))
        text = 'port of the page; 0: one that is free'
        port = int(parameter(self, 'port', 8080, text, within=(0, 65535)))
        text = 'names of the page in requests, separated by commas'
        names = [n for n in str(parameter(self, 'allow_host', '', text)).split(',') if n]
        tokens = (os.environ.get(name, '') for name in (TOKEN_VARIABLE, INSTRUCTOR_VARIABLE))
        gate = make_gate(host, names, *tokens)
        exercises = exercise_titles() if self._launched else {}
        controls = LiveControls(
            tuple(scene_names()), METHODS, session=self._launched, exercises=exercises
        )
        self._server = PageServer(host, port, gate, 'live', controls, self._act)
        port = self._server.port
        self._links = {
            'page': link(host, port, names, gate.token),
            'instructor': link(host, port, names, gate.instructor_token, 'instructor'),
        }
        if not is_local(host):
            self._links = {of: f'{url} {OPEN_LINK_WARNING}' for of, url in self._links.items()}
        self._page = LivePage(self._server, self._tools, self._exercise, controls)
        self._page.show_scale(self._force_scale)

    def _marker_colours(self) -> tuple[Any, float]:
        """Return the coloured quantity, and the value of the last colour; 0: by the scene."""
        text = 'of the tissue in viewer/markers: displacement or von_mises'
        colouring = str(parameter(self, 'marker_colour', 'displacement', text))
        if colouring not in get_args(Colouring):
            known = ' or '.join(get_args(Colouring))
            raise ValueError(f'marker_colour is {colouring!r}: use {known}')
        text = "value of the last colour [m] or [Pa]; 0: 0.01 m, or a tenth of Young's modulus"
        return colouring, float(parameter(self, 'marker_largest', 0.0, text, within=(0.0, 1e12)))

    def _take_scene(self, scene: Path) -> None:
        device = read_section(scene, 'device', DeviceSettings)
        self._force_topic = f'{ros.ARM}/{device.force_topic}'
        self._translator = Translator(device)
        tool = read_section(scene, 'tool', ToolSettings)
        for other in self._further:
            other.close()
        self._further = further_tools(self, scene)
        self._tools = [tool, *(other.tool for other in self._further)]
        self._exercise = read_section(scene, 'exercise', ExerciseSettings)
        haptics = read_section(scene, 'haptics', HapticsSettings)
        tissue = read_section(scene, 'tissue', TissueSettings)
        self._nominal = haptics.rate, tissue.integration.rate
        self._force_scale = haptics.force_scale
        material = tissue.material
        moduli = np.array([material.youngs_modulus, *tissue.region_values('youngs_modulus')])
        self._markers = Markers(ros.FRAME, *self._colouring, moduli, material.poissons_ratio)
        self._device = device

    @property
    def progress(self) -> int:
        """Return the number of loop iterations."""
        return self._loop.ticks

    def work(self, stop: Stop) -> None:
        """Update the page in a loop."""
        if self._launched and self._listener is None:
            self._listener = threading.Thread(target=self._listen, daemon=True)
            self._listener.start()
        self._ask_launcher(**self._links)
        announce_ready(self)
        self._loop.start()
        while not stop.is_set():
            self._loop.wait()
            self._tick(time.monotonic())

    def release(self) -> None:
        """Close the page."""
        self._server.stop()

    def _tick(self, now: float) -> None:
        self._server.tick()
        self._follower.poll()
        for stream in (self._contact, self._wrench, self._pose):
            stream.poll(now)
        if self._pose.newest is not None:
            self._frames.add_frame(self._pose.newest.frame_id)
        if (sample := ros.take_numbered(self._samples)) is not None:
            self._reactions.see(now, sample[1])
        self._serve(now)
        moment = None
        if self._contact.newest is not None:
            moment = self._translator.moment(
                self._contact.newest, self._pose.newest, self._wrench.newest, self._indexing
            )
        rates = (
            self._wrench.counter.rate(now) / self._nominal[0],
            self._reactions.rate(now) / self._nominal[1],
        )
        operation = self._operation
        can_guide = operation.can_guide
        further = [drawn(other.moment(now)) for other in self._further]
        self._page.show(
            now, self._follower.replica, moment, rates, can_guide=can_guide, further=further
        )
        if self._page.scored and not self._scored:
            self._ask_launcher(ask='finish')
        self._scored = self._page.scored
        held = self._held
        self._page.show_state(
            str(operation.state or ''),
            self._state_text(now, held=held),
            self._guided_text() if can_guide else '',
            e_stopped=operation.e_stopped,
            held=held,
        )
        self._page.show_nodes(now, self._statuses.now(now))
        self._follow_scale()
        self._publish_markers(now, moment)

    def _take_indexing(self, message: IndexingMessage) -> None:
        self._indexing = Indexing.read(message)

    def _serve(self, now: float) -> None:
        """Execute the queued work of pages, launcher and services."""
        for change in taken(self._calls):
            change()
        for message in self._asked.taken():
            self._do(message)
        while self._server.failures:
            self.get_logger().error(f'asked by a page: {self._server.failures.pop(0)}')
        self._operation.go_on(now)

    def _publish_markers(self, now: float, moment: Moment | None) -> None:
        """Publish markers ten times a second, where a node subscribes."""
        replica = self._follower.replica
        if now < self._next_markers or replica.revision < 0:
            return
        if self._marker_array.get_subscription_count() > 0:
            self._next_markers = now + MARKER_PERIOD_S
            data = self._markers.array(replica, moment, self._tools[0].radius, time.time_ns())
            self._marker_array.publish(data)

    # Requests of pages

    def _act(self, message: AnyMessage) -> None:
        """Execute a request, in the server's thread: E-STOP and goals at once, the rest queued."""
        if isinstance(message, EStop):
            self._operation.stop_at_once()
            self._asked.clear()  # an earlier start
        elif isinstance(message, Guide):
            self._operation.guide(message)
        elif isinstance(message, Start) and self._held:  # before the controls show it
            self._calls.put(lambda: self._page.warn(HELD))
        else:
            if isinstance(message, Hold):
                self._held = message.on
            self._asked.put(message)

    def _do(self, message: AnyMessage) -> None:
        match message:
            case Start():
                self._operation.start()
            case Pause():
                self._operation.pause()
            case Hold():
                self._hold(on=message.on)
            case ResetEStop():
                self._operation.reset_stop()
            case Reset():
                self._reset()
            case Record():
                self._ask_launcher(ask='record', on=message.on)
            case Choose():
                self._ask_launcher(ask='restart', scene=message.scene, method=message.method)
            case Attempt():
                self._ask_launcher(ask='attempt', scene=message.scene, subject=message.subject)
            case SetTissue():
                tissue = {'stiffness': message.stiffness, 'toughness': message.toughness}
                self._ask_launcher(ask='restart', tissue=tissue)
            case Watch():
                self._ask_launcher(ask='watch', bags=message.bags, number=message.number)
            case Scale():
                self._scale(message.value)

    def _hold(self, *, on: bool) -> None:
        """Pause, or enable the force again, unless an E-STOP holds."""
        if on:
            self._operation.pause()
        elif not self._operation.e_stopped:
            self._operation.start()

    def _reset(self) -> None:
        """Make the tissue whole; with a bag, the launcher ends it and begins another."""
        if self._page.is_recording:
            self._ask_launcher(ask='restart')
            return
        self._operation.pause()
        self._resetter.ask()

    def _scale(self, value: float) -> None:
        def take(*, holds: bool) -> None:
            if holds:
                self._force_scale = value
                self._statuses.take_scale()  # an older report
            self._page.show_scale(self._force_scale)

        self._operation.scale(value, lambda holds: self._calls.put(lambda: take(holds=holds)))

    def _follow_scale(self) -> None:
        """Show the force scale that the bridge reports, whoever has set it."""
        scale = self._statuses.take_scale()
        if scale is not None and not math.isclose(scale, self._force_scale, rel_tol=1e-6):
            self._force_scale = scale
            self._page.show_scale(scale)

    # Between the launcher and this node

    def _ask_launcher(self, **content: object) -> None:
        announce(f'message: {json.dumps(content)}')

    def _listen(self) -> None:
        for line in sys.stdin:
            answer = SessionState(**json.loads(line))
            self._calls.put(lambda answer=answer: self._take_answer(answer))  # type: ignore[misc]

    def _take_answer(self, answer: SessionState) -> None:
        if answer.scene_file:
            self._take_scene(Path(answer.scene_file))
            self._frames.place(self._device)
            self._page.equip(self._tools, self._exercise)
            self._statuses.take_scale()
            self._page.show_scale(self._force_scale)
        if answer.busy:
            self._statuses.forget()
        elif not answer.recording:
            self._statuses.forget(RECORDER)  # its last status comes after its end
        self._page.show_session(answer)

    def _guided_text(self) -> str:
        """Return how the pointer moves the tool."""
        deed = 'cut' if self._tools[0].mode == 'scalpel' else 'press'
        return f'The tool follows the pointer; hold the button to {deed}.'

    def _state_text(self, now: float, *, held: bool) -> str:
        """Return the text for the operating state."""
        bridge, state = self._statuses.said(BRIDGE, now), self._operation.state
        if bridge is None:
            return 'The haptic bridge is silent.'
        if self._operation.e_stopped:
            return 'E-STOP: no force until it is reset, and then Start.'
        if held and state in (CrtkState.PAUSED, CrtkState.DISABLED):
            return f'{HELD} No force until then.'
        said = {
            CrtkState.ENABLED: 'Force is on.',
            CrtkState.PAUSED: 'No force. Start goes on.',
            CrtkState.DISABLED: 'No force. Start enables it.',
            CrtkState.FAULT: f'{bridge}. No force until Start.',
        }
        return said[state] if state is not None else ''

    def _status(self) -> tuple[bytes, str, dict[str, object]]:
        pages = self._server.pages
        values: dict[str, object] = dict(self._loop.report())
        values |= {'pages': pages, 'revision_gaps': self._follower.gaps}
        return DiagnosticStatus.OK, f'{pages} page{"s" * (pages != 1)}', values


def main() -> None:
    """Run the node."""
    # The viewer has a lower priority than the nodes of the loop. Set first: existing threads, such
    # as the one that serves the pages, would keep theirs.
    os.nice(_NICENESS)
    run(ViewerNode)


if __name__ == '__main__':
    main()
