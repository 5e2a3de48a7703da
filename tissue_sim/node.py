"""The node `tissue_sim`: the tissue at 30 Hz."""

import time
from pathlib import Path
from typing import Any

from cutting_trainer_msgs.msg import Contact, ForceSample, FrameInputs, Mesh, MeshDelta
from cutting_trainer_msgs.srv import Cut, GetMesh
from diagnostic_msgs.msg import DiagnosticStatus

from tissue_sim import messages, ros
from tissue_sim.assembly import as_planned, make_simulation
from tissue_sim.checkpoint import Checkpoint, read_checkpoint
from tissue_sim.contact import Command, Frame, ToolContact
from tissue_sim.errors import MeshError
from tissue_sim.keepers import ask_keepers
from tissue_sim.lifecycle import ManagedNode, Stop, announce_ready, run
from tissue_sim.link_budget import LinkBudget
from tissue_sim.mesh import Touched
from tissue_sim.parameters import announced, parameter, scene_parameter, seed_parameter
from tissue_sim.plan_watch import PlanWatch
from tissue_sim.refusals import MessageError
from tissue_sim.replica import MeshReplica
from tissue_sim.scene_file import read_section
from tissue_sim.settings import TissueSettings
from tissue_sim.timing import PeriodicLoop, Turns, request_preference
from tissue_sim.tool_contact import tool_contact

_CONTACT_AGE_NS = 100_000_000
_KEYFRAME_SECONDS = 5.0
_STOOD_STILL = 1.0
"""[s] between two frames after which another node may have been started in its place."""
_SUSPICION = 5.0
"""[s] after that in which it looks for one."""
_CHECKPOINT_SECONDS = 0.5
"""Between two meshes that go to the checkpoint because of cuts."""
_CUT_TIMEOUT_NS = 1_000_000_000
_NICENESS = -10
_FOUND = 0.5
"""[s] in which a recorder that is there has found a new topic, and subscribed to it."""


class TissueSimNode(ManagedNode):
    """Owns the tissue; see docs/architecture.md for its topics."""

    def __init__(self) -> None:
        super().__init__('tissue_sim')

    def configure(self) -> None:
        """Reads the scene, makes the tissue and the topics."""
        scene = Path(scene_parameter(self))
        seed_parameter(self)
        text = 'go on with the tissue as its followers know it, in the place of a node that died'
        self._resumes = bool(parameter(self, 'resume', False, text))
        settings = read_section(scene, 'tissue', TissueSettings)
        # First, so that a recorder finds it while the tissue is made.
        self._inputs = self.create_publisher(FrameInputs, ros.FRAME_INPUTS, ros.STREAM)
        self._announced = time.monotonic()
        self._scene = scene.stem
        text = 'file in which the tissue is kept, for the node that takes the place of this one'
        file = str(parameter(self, 'checkpoint', '', text))
        self._file = Path(file) if file else None
        before = self._tissue_before() if self._resumes else None
        self._checkpoint = Checkpoint(self._file) if self._file else None
        self._simulation, plan = make_simulation(settings, before)
        self._plan = None if plan is None else PlanWatch(plan, self._simulation)
        self._log_plan()
        self._announce_method(as_planned(settings, plan))
        text = 'largest flow of meshes and their deltas [bytes/s]; 0: no limit'
        self._link = LinkBudget(
            float(parameter(self, 'mesh_bandwidth', 0.0, text, within=(0.0, 1e12)))
        )
        self._loop = PeriodicLoop(settings.integration.rate)
        self._encoder = messages.DeltaEncoder(self._simulation.mesh, self._simulation.displacement)
        self._encoder.revision = 0 if before is None else before.revision
        self._lock = Turns()
        self._contact: Contact | None = None
        self._contact_received = 0
        self._touched: Touched | None = None
        self._cut: Any = None
        self._cut_sent = 0
        self._cut_step = 0
        self._answer = FrameInputs.NO_ANSWER
        self._next_keyframe = self._next_checkpoint = 0.0
        self._frame: Frame | None = None
        self._ticked = self._suspects = 0.0
        self._diverged = 0
        self._connect()

    def _tissue_before(self) -> MeshReplica | None:
        """The tissue of the node that had this one's place, as those who followed it know it."""
        newest = MeshReplica()
        for mesh in (*ask_keepers(self), *(read_checkpoint(self._file) if self._file else [])):
            if (mesh.topology, mesh.revision) > (newest.topology, newest.revision):
                newest.load(mesh)
        if newest.revision < 0:
            self.get_logger().warning('nobody knows the tissue as it was: it begins whole')
            return None
        self.get_logger().warning(
            f'takes the place of one that died: from frame {newest.step}, '
            f'after {newest.topology} changes by cuts'
        )
        return newest

    def _log_plan(self) -> None:
        if self._plan is None:
            return
        for sentence in self._plan.announcement():
            self.get_logger().info(sentence)
        for sentence in self._plan.warnings:
            self.get_logger().warning(sentence)

    def _announce_method(self, taken: TissueSettings) -> None:
        """Says what the tissue is computed by; from the bag, a session is computed again by it."""
        for name, value in taken.method_taken.items():
            announced(self, name, value, f'tissue.{name} that the simulation goes by')

    def _connect(self) -> None:
        self._mesh_publisher = self.create_publisher(Mesh, ros.MESH, ros.LATCHED)
        self._updates = self.create_publisher(MeshDelta, ros.MESH_UPDATES, ros.UPDATES)
        self._forces = self.create_publisher(ForceSample, ros.FORCE, ros.STREAM)
        self._contacts = ros.polled(self, Contact, ros.CONTACT, ros.NEWEST_BEST_EFFORT)
        self._cutting = self.create_client(Cut, ros.CUT)
        service = self.create_service(GetMesh, ros.GET_MESH, self._serve_mesh)
        ros.introspect(self, service, contents=False)  # whole meshes are in the bag as it is
        self._diagnostics = ros.Diagnostics(self, self._status)

    def work(self, stop: Stop) -> None:
        """Runs frames to the end."""
        self.get_logger().info(request_preference(_NICENESS))
        self._await_recorder(stop)
        with self._lock:
            self._publish_keyframe()
        announce_ready(self)
        self._loop.start()
        self._ticked = time.monotonic()
        while not stop.is_set() and not self.ended:
            self._loop.wait()
            self._yield_place()
            with self._lock:
                self._tick()
            self._diagnostics.catch_up()

    def _await_recorder(self, stop: Stop) -> None:
        """Lets a recorder find the inputs of frames: only a whole record is computed again."""
        until = self._announced + _FOUND
        while self._inputs.get_subscription_count() == 0 and time.monotonic() < until:
            if stop.is_set():
                return
            time.sleep(0.005)

    def release(self) -> None:
        """Ends the thread of the checkpoint."""
        if self._checkpoint is not None:
            self._checkpoint.close()

    def _tick(self) -> None:
        self._take_answer()
        contact = self._newest_contact()
        frame = self._simulation.frame(contact)
        over = self._plan.follow(frame) if self._plan else ''
        if over:
            self.get_logger().warning(over, throttle_duration_sec=5.0)
        now = time.time_ns()
        used = None if contact is None else self._contact
        self._inputs.publish(
            messages.inputs_message(frame, used, self._answer, self._cut_step, now)
        )
        self._answer = FrameInputs.NO_ANSWER
        delta = None
        if self._touched is not None or frame.command is not None or self._link.allows(now * 1e-9):
            delta = self._encoder.encode(
                self._simulation.displacement, frame.step, now, self._touched, self._cut_step
            )
        if self._touched is not None and time.monotonic() >= self._next_checkpoint:
            self._keep(self._mesh_message())
        self._touched = None
        self._frame = frame
        self._forces.publish(
            messages.force_message(
                frame,
                self._encoder.revision,
                self._simulation.mesh.topology,
                used,
                now,
            )
        )
        self._diverged += frame.diverged
        if frame.trouble:
            self.get_logger().error(frame.trouble, throttle_duration_sec=1.0)
        if delta is not None:
            self._updates.publish(delta)
            self._link.spend(delta)
        if time.monotonic() >= self._next_keyframe:
            self._publish_keyframe()
        if frame.command is not None:
            self._ask(frame)

    def _newest_contact(self) -> ToolContact | None:
        now = time.monotonic_ns()
        try:
            message = ros.take(self._contacts, self.max_message)
            if message is not None:
                self._contact, self._contact_received = message, now
            if self._contact is None or now - self._contact_received > _CONTACT_AGE_NS:
                return None
            return tool_contact(self._contact, self._simulation.mesh)
        except ValueError as error:
            self.refusals.add(ros.CONTACT, error)
            self._contact = None  # one message is refused once
            return None

    def _ask(self, frame: Frame) -> None:
        request = Cut.Request(command=int(frame.command or 0), revision=self._encoder.revision)
        if frame.sweep is not None:
            request.root_from, request.tip_from = frame.sweep.root_from, frame.sweep.tip_from
            request.root_to, request.tip_to = frame.sweep.root_to, frame.sweep.tip_to
        self._cut_step = frame.step
        if not self._cutting.service_is_ready():
            if frame.command == Command.FINISH:
                self._simulation.cut_done()  # nobody is there who could remember the stroke
                self._answer = FrameInputs.GIVEN_UP
                return
            self._lose_cut(MessageError('the service is not there'))
            return
        self._cut = self._cutting.call_async(request)
        self._cut_sent = time.monotonic_ns()

    def _take_answer(self) -> None:
        if self._cut is None:
            return
        if not self._cut.done():
            if time.monotonic_ns() - self._cut_sent > _CUT_TIMEOUT_NS:
                self._cutting.remove_pending_request(self._cut)
                self._cut = None
                self._lose_cut(MessageError('no answer within a second'))
            return
        response, self._cut = self._cut.result(), None
        try:
            if response.error_code == Cut.Response.INVALID_SWEEP:
                self._simulation.cut_done()
                self._answer = FrameInputs.REFUSED
                text = f'{response.error_msg}: this sweep stays uncut'
                self.refusals.add(ros.CUT, MessageError('invalid sweep', text))
                return
            if not response.success:
                raise MessageError('no cut', response.error_msg)
            if response.topology != self._simulation.mesh.topology:
                raise MessageError('another topology', f'it is for topology {response.topology}')
            delta = messages.delta_from(response)
            if delta.empty:
                self._simulation.cut_done()
                self._answer = FrameInputs.EMPTY
            else:
                self._touched = self._simulation.apply_cut(delta)
                self._answer = FrameInputs.APPLIED
        except (ValueError, MeshError) as error:
            self._lose_cut(error)

    def _lose_cut(self, why: Exception) -> None:
        self._simulation.cut_failed()
        self._answer = FrameInputs.LOST
        self.refusals.add(ros.CUT, why)

    def _publish_keyframe(self) -> None:
        message = self._mesh_message()
        self._mesh_publisher.publish(message)
        self._link.spend(message)
        self._keep(message)
        self._next_keyframe = time.monotonic() + _KEYFRAME_SECONDS

    def _keep(self, message: Mesh) -> None:
        if self._checkpoint is not None:
            self._checkpoint.offer(message)
            self._next_checkpoint = time.monotonic() + _CHECKPOINT_SECONDS

    def _mesh_message(self) -> Mesh:
        return messages.mesh_message(
            self._simulation.mesh,
            self._simulation.displacement,
            self._scene,
            self._encoder.revision,
            self._simulation.step,
            time.time_ns(),
        )

    def _serve_mesh(self, _: GetMesh.Request, response: GetMesh.Response) -> GetMesh.Response:
        with self._lock:
            response.mesh = self._mesh_message()
        response.success = True
        return response

    def _yield_place(self) -> None:
        """Ends a node that stood still for so long that another has taken its place meanwhile."""
        late = time.monotonic() - self._ticked
        self._ticked = time.monotonic()
        if late > _STOOD_STILL:
            self._suspects = self._ticked + _SUSPICION
        if self._ticked < self._suspects and self._namesakes() > 1:
            self.get_logger().error(
                f'stood still for {late:.1f} s, and another tissue_sim has its place now: ends'
            )
            self.ended = True

    def _namesakes(self) -> int:
        """Nodes of this one's name that publish the mesh; of others the followers take care."""
        own = self.get_name(), self.get_namespace()
        publishers = self.get_publishers_info_by_topic(self._mesh_publisher.topic_name)
        return sum((info.node_name, info.node_namespace) == own for info in publishers)

    def _status(self) -> tuple[bytes, str, dict[str, object]]:
        with self._lock:  # a cut changes mesh and displacement one after the other
            return self._status_now()

    def _status_now(self) -> tuple[bytes, str, dict[str, object]]:
        values: dict[str, object] = dict(self._loop.report())
        simulation, frame = self._simulation, self._frame
        values |= {
            'tetrahedra': len(simulation.mesh.tetrahedra),
            'nodes': simulation.mesh.node_count,
            'elements_cut': simulation.elements_cut,
            'topology': simulation.mesh.topology,
            'omega_bound': simulation.dynamics.omega,
            'step_bound': simulation.dynamics.bound(),
            'active_nodes': simulation.dynamics.active_nodes,
            'inverted': simulation.dynamics.inverted,
            'mesh_bytes': self._link.sent,
            'deltas_held_back': self._link.held_back,
        }
        values |= self._plan.values() if self._plan else {}
        values['diverged_frames'] = self._diverged
        if frame is None:
            return DiagnosticStatus.OK, 'starting', values
        values |= {'substeps': frame.substeps, 'slow_motion': frame.slow_motion}
        if frame.diverged:
            return DiagnosticStatus.ERROR, f'a frame was taken back: {frame.trouble}', values
        if frame.trouble:
            return DiagnosticStatus.WARN, frame.trouble, values
        if self._plan and self._plan.over:
            return DiagnosticStatus.WARN, self._plan.over, values
        if frame.slow_motion < 0.999:
            return DiagnosticStatus.WARN, 'max_substeps is too small for real time', values
        if self._plan and self._plan.unmet:
            return DiagnosticStatus.WARN, self._plan.unmet, values
        said = frame.state.name.lower() if frame.state else 'no contact'
        return DiagnosticStatus.OK, said, values


def main() -> None:
    """Runs the node."""
    run(TissueSimNode)


if __name__ == '__main__':
    main()
