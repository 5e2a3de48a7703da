"""The node `viewer`: a page in the browser on a session that runs."""

import json
import math
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any, get_args

from cutting_trainer_msgs.msg import Contact, ForceSample
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from visualization_msgs.msg import MarkerArray

from haptic_bridge.operating_state import E_STOP, State, crtk_types
from haptic_bridge.settings import DeviceSettings, HapticsSettings, ToolSettings
from haptic_bridge.wire import ContactCodec, PoseStampedCodec, StampedCodec, WrenchStampedCodec
from tissue_sim import ros
from tissue_sim.lifecycle import ManagedNode, Stop, announce_ready, run
from tissue_sim.mesh_follower import MeshFollower
from tissue_sim.parameters import parameter, scene_parameter
from tissue_sim.refusals import MessageError
from tissue_sim.scene_file import read_section
from tissue_sim.settings import TissueSettings
from tissue_sim.share import share_folder
from tissue_sim.timing import PeriodicLoop
from viewer.frames import StaticFrames
from viewer.history import Counter
from viewer.live_page import LivePage, SessionState
from viewer.markers import Colouring, Markers
from viewer.moment import Moment, Translator
from viewer.page import addresses, open_page
from viewer.panel import Actions, NodeState

MARKER_PERIOD = 0.1
"""[s] between two sets of markers."""
HEARING = 0.1
"""[s] in which the haptic bridge has heard of the arm's state, too."""
RATE = 30.0
"""Updates of the page [Hz], at most."""
_NICENESS = 10
_MOST_NODES, _LONGEST_TEXT = 32, 1000
"""Of what /diagnostics says: nodes in the table, characters of a text."""
_FASTEST, _LAST_LEVEL = 1e6, 3
BRIDGE, RECORDER = 'haptic_bridge', 'recorder'


class Stream:
    """The newest valid message of a fast topic, and how many a second there are.

    Args:
        node: to subscribe with.
        message_type, topic: of the messages.
        codec: that reads them.
    """

    def __init__(
        self, node: ManagedNode, message_type: Any, topic: str, codec: StampedCodec
    ) -> None:
        self.newest: Any = None
        self.counter = Counter()
        self._codec, self._topic, self._refusals = codec, topic, node.refusals
        self._subscription = ros.polled(node, message_type, topic, ros.NEWEST_BEST_EFFORT)

    def poll(self, now: float) -> None:
        """Takes what has come by a time [s]."""
        if (taken := ros.take_numbered(self._subscription)) is not None:
            self.counter.see(now, taken[1])
            try:
                sample = self._codec.believed(taken[0])
            except MessageError as error:
                self._refusals.add(self._topic, error)
                return
            if sample.stamp_ns:  # else of no device yet
                self.newest = sample


class ViewerNode(ManagedNode):
    """Shows the graph and operates it; see docs/view.md.

    Parameters:
        scene: path of the scene file.
        host, port: where the page is served; port 0: one that is free.
        marker_colour: of the tissue in `viewer/markers`: displacement or von_mises.
        marker_largest: what has the last colour [m] or [Pa]; 0: 0.01 m, or a tenth of Young's
            modulus.
        session: a launcher reads `message: ...` on standard output and answers on standard input,
            so that nodes can be started again, and recorded.
    """

    def __init__(self) -> None:
        super().__init__('viewer')
        self._listener: threading.Thread | None = None

    def configure(self) -> None:
        """Reads the scene, opens the page and makes the topics."""
        scene = Path(scene_parameter(self))
        host = str(parameter(self, 'host', '127.0.0.1', 'address that the page is served on'))
        text = 'port of the page; 0: one that is free'
        port = int(parameter(self, 'port', 8080, text, within=(0, 65535)))
        self._colouring = self._marker_colours()
        text = 'a launcher reads standard output and answers on standard input'
        self._launched = bool(parameter(self, 'session', False, text))
        self._take_scene(scene)
        self._follower = MeshFollower(self, self.refusals)
        self._contact = Stream(self, Contact, ros.CONTACT, ContactCodec())
        self._wrench = Stream(self, WrenchStamped, f'{ros.ARM}/servo_cf', WrenchStampedCodec())
        self._pose = Stream(self, PoseStamped, f'{ros.ARM}/measured_cp', PoseStampedCodec())
        self._reactions = Counter()
        self._samples = ros.polled(self, ForceSample, ros.FORCE, ros.NEWEST_BEST_EFFORT)
        self._connect()
        self._state: State | None = None
        self._arm_state: State | None = None
        self._starting = False
        self._enable_at = math.inf
        self._nodes: dict[str, tuple[float, NodeState]] = {}
        self._answers: list[SessionState] = []
        actions = Actions(
            start=self._start,
            pause=self._pause,
            e_stop=self._stop_at_once,
            reset=lambda: self._ask('restart'),
            record=lambda on: self._ask('record', on=on),
            choose=lambda scene, method: self._ask('restart', scene=scene, method=method),
            scale=self._scale,
        )
        self._server = open_page(host, port)
        self._page = LivePage(
            self._server, self._tool, actions, known_scenes(), self._guide, session=self._launched
        )
        self._page.show_scale(self._force_scale)
        self._loop = PeriodicLoop(RATE)
        self._next_markers = 0.0
        self._diagnostics = ros.Diagnostics(self, self._status)

    def _marker_colours(self) -> tuple[Any, float]:
        """What the colour of the markers shows, and what has the last one; 0: by the scene."""
        text = 'of the tissue in viewer/markers: displacement or von_mises'
        colouring = str(parameter(self, 'marker_colour', 'displacement', text))
        if colouring not in get_args(Colouring):
            known = ' or '.join(get_args(Colouring))
            raise ValueError(f'marker_colour is {colouring!r}: use {known}')
        text = "what has the last colour [m] or [Pa]; 0: 0.01 m, or a tenth of Young's modulus"
        return colouring, float(parameter(self, 'marker_largest', 0.0, text, within=(0.0, 1e12)))

    def _take_scene(self, scene: Path) -> None:
        device = read_section(scene, 'device', DeviceSettings)
        self._translator = Translator(device)
        self._tool = read_section(scene, 'tool', ToolSettings)
        haptics = read_section(scene, 'haptics', HapticsSettings)
        tissue = read_section(scene, 'tissue', TissueSettings)
        self._nominal = haptics.rate, tissue.integration.rate
        self._force_scale = haptics.force_scale
        material = tissue.material
        self._markers = Markers(
            ros.FRAME, *self._colouring, material.youngs_modulus, material.poissons_ratio
        )
        self._device = device

    def _connect(self) -> None:
        types = crtk_types()
        self._command = types.command
        self._to_bridge = self.create_publisher(
            types.command, f'{BRIDGE}/state_command', ros.EVENTS
        )
        self._to_arm = self.create_publisher(types.command, f'{ros.ARM}/state_command', ros.EVENTS)
        self._goal = self.create_publisher(PoseStamped, ros.HAND, ros.EVENTS)
        self._setter = self.create_client(SetParameters, f'{BRIDGE}/set_parameters')
        self._marker_array = self.create_publisher(MarkerArray, ros.MARKERS, ros.EVENTS)
        self._frames = StaticFrames(self, self._device)
        for name, take in ((BRIDGE, self._bridge_state), (ros.ARM, self._arm_says)):
            topic = f'{name}/operating_state'
            ros.listen(self, types.operating_state, topic, take, ros.LATCHED)
        ros.listen(self, DiagnosticArray, ros.DIAGNOSTICS, self._take_status, ros.EVENTS)

    def work(self, stop: Stop) -> None:
        """Brings the page up to date, again and again."""
        if self._launched and self._listener is None:
            self._listener = threading.Thread(target=self._listen, daemon=True)
            self._listener.start()
        self._tell(page=addresses(self._server))
        announce_ready(self)
        self._loop.start()
        while not stop.is_set():
            self._loop.wait()
            self._tick(time.monotonic())

    def release(self) -> None:
        """Ends the page."""
        self._server.stop()

    def _tick(self, now: float) -> None:
        self._follower.poll()
        for stream in (self._contact, self._wrench, self._pose):
            stream.poll(now)
        if self._pose.newest is not None:
            self._frames.learn(self._pose.newest.frame_id)
        if (taken := ros.take_numbered(self._samples)) is not None:
            self._reactions.see(now, taken[1])
        if now >= self._enable_at:
            self._enable_bridge()
        while self._answers:
            self._take_answer(self._answers.pop(0))
        moment = None
        if self._contact.newest is not None:
            moment = self._translator.moment(
                self._contact.newest, self._pose.newest, self._wrench.newest
            )
        rates = (
            self._wrench.counter.rate(now) / self._nominal[0],
            self._reactions.rate(now) / self._nominal[1],
        )
        can_guide = self._state is State.ENABLED and self._goal.get_subscription_count() > 0
        self._page.show(now, self._follower.replica, moment, rates, can_guide=can_guide)
        self._page.show_state(str(self._state or ''), self._said(now, can_guide=can_guide))
        self._page.show_nodes(now, self._nodes_now(now))
        self._publish_markers(now, moment)

    def _publish_markers(self, now: float, moment: Moment | None) -> None:
        """Ten times a second, where somebody listens."""
        replica = self._follower.replica
        if now < self._next_markers or replica.revision < 0:
            return
        if self._marker_array.get_subscription_count() > 0:
            self._next_markers = now + MARKER_PERIOD
            data = self._markers.array(replica, moment, self._tool.radius, time.time_ns())
            self._marker_array.publish(data)

    # What operators do

    def _start(self) -> None:
        # The bridge refuses while its device cannot take a force: the arm comes first.
        if self._arm_state in (None, State.ENABLED):
            self._enable_bridge()
        else:
            self._starting = True
            self._send(self._to_arm, 'resume' if self._arm_state is State.PAUSED else 'enable')

    def _enable_bridge(self) -> None:
        self._starting, self._enable_at = False, math.inf
        self._send(self._to_bridge, 'resume' if self._state is State.PAUSED else 'enable')

    def _pause(self) -> None:
        self._starting, self._enable_at = False, math.inf
        self._send(self._to_bridge, 'pause')
        self._send(self._to_arm, 'pause')

    def _stop_at_once(self) -> None:
        self._starting, self._enable_at = False, math.inf
        self._send(self._to_bridge, E_STOP)
        self._send(self._to_arm, 'disable')

    def _send(self, publisher: Any, word: str) -> None:
        message = self._command(string=word)
        message.header.stamp = ros.stamp(time.time_ns())
        publisher.publish(message)

    def _guide(self, position: Any, wxyz: Any) -> None:
        """Gives the emulated hand a goal in the tissue frame."""
        message = PoseStamped()
        message.header.frame_id = ros.FRAME
        message.header.stamp = ros.stamp(time.time_ns())
        place, turn = message.pose.position, message.pose.orientation
        place.x, place.y, place.z = map(float, position)
        turn.w, turn.x, turn.y, turn.z = map(float, wxyz)
        self._goal.publish(message)

    def _scale(self, scale: float) -> None:
        value = Parameter('force_scale', Parameter.Type.DOUBLE, float(scale))
        request = SetParameters.Request(parameters=[value.to_parameter_msg()])
        if not self._setter.service_is_ready():
            self._page.warn('the haptic bridge does not answer: the force scale stays')
            return
        self._setter.call_async(request).add_done_callback(
            lambda future: self._scaled(scale, future.result())
        )

    def _scaled(self, scale: float, response: Any) -> None:
        result = response.results[0]
        if result.successful:
            self._force_scale = scale
        else:
            self._page.warn(f'force scale {scale:g} refused: {result.reason}')
        self._page.show_scale(self._force_scale)

    # Between the launcher and this node

    def _ask(self, what: str, **details: object) -> None:
        if self._launched:
            self._tell(ask=what, **details)

    def _tell(self, **content: object) -> None:
        print(f'message: {json.dumps(content)}', flush=True)

    def _listen(self) -> None:
        for line in sys.stdin:
            self._answers.append(SessionState(**json.loads(line)))

    def _take_answer(self, answer: SessionState) -> None:
        if answer.scene_file:
            self._take_scene(Path(answer.scene_file))
            self._frames.place(self._device)
            self._page.equip(self._tool)
            self._page.show_scale(self._force_scale)
        if answer.busy:
            self._nodes.clear()
        elif not answer.recording:
            self._nodes.pop(RECORDER, None)  # its last words are heard when it has been ended
        self._page.show_session(answer)

    # What the nodes say

    def _bridge_state(self, message: Any) -> None:
        self._state = known_state(message.state)

    def _arm_says(self, message: Any) -> None:
        self._arm_state = known_state(message.state)
        if self._starting and self._arm_state is State.ENABLED:
            self._enable_at = time.monotonic() + HEARING

    def _take_status(self, message: DiagnosticArray) -> None:
        own = self.get_namespace().strip('/')
        for status in message.status:
            name = name_within(own, status.name)
            if not name:
                continue  # another trainer's, beside this one
            known = name in self._nodes or len(self._nodes) < _MOST_NODES
            if not known or len(name) > _LONGEST_TEXT or len(status.message) > _LONGEST_TEXT:
                raise MessageError('a status too many or too long', f'of {len(message.status)}')
            values = {pair.key: pair.value for pair in status.values}
            rate, level = float(values.get('rate', 0.0)), status.level[0]
            if not 0 <= rate <= _FASTEST or level > _LAST_LEVEL:
                raise MessageError('no such rate or level', f'rate {rate:g}, level {level}')
            self._nodes[name] = (time.monotonic(), NodeState(name, level, status.message, rate))

    def _nodes_now(self, now: float) -> list[NodeState]:
        states = []
        for name in sorted(self._nodes):
            heard, state = self._nodes[name]
            if now - heard > 3.0:
                silent = f'silent for {now - heard:.0f} s'
                state = state._replace(level=3, message=silent, rate=0.0)
            states.append(state)
        return states

    def _said(self, now: float, *, can_guide: bool) -> str:
        """What is to be said about the operating state."""
        heard, bridge = self._nodes.get(BRIDGE, (0.0, None))
        if bridge is None or now - heard > 3.0:
            return 'The haptic bridge is silent.'
        handles = 'Drag the handles at the blade to move it.' if can_guide else ''
        said = {
            State.ENABLED: f'Force is on. {handles}',
            State.PAUSED: 'No force. Start goes on.',
            State.DISABLED: 'No force. Start lets it in.',
            State.FAULT: f'{bridge.message}. No force until Start.',
        }
        return said[self._state] if self._state is not None else ''

    def _status(self) -> tuple[bytes, str, dict[str, object]]:
        pages = len(self._server.get_clients())
        values: dict[str, object] = dict(self._loop.report())
        values |= {'pages': pages, 'revision_gaps': self._follower.gaps}
        return DiagnosticStatus.OK, f'{pages} page{"s" * (pages != 1)}', values


def name_within(namespace: str, name: str) -> str:
    """A name on /diagnostics as it is in a namespace ('': all); '' where it is not in it."""
    prefix = f'{namespace}/' if namespace else ''
    return name.removeprefix(prefix) if name.startswith(prefix) else ''


def known_state(name: str) -> State | None:
    """One of CRTK's states; None where a foreign device says something else."""
    return next((state for state in State if state == name), None)


def known_scenes() -> list[str]:
    """Names of the scenes that come with the trainer."""
    return sorted(path.stem for path in (share_folder() / 'config' / 'scenes').glob('*.yaml'))


def main() -> None:
    """Runs the node."""
    # Whoever looks on waits, not those who act. Threads that there are already would stay as they
    # are, the one that serves the pages among them.
    os.nice(_NICENESS)
    run(ViewerNode)


if __name__ == '__main__':
    main()
