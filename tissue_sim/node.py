"""The node `tissue_sim`: the tissue at 30 Hz."""

import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

from cutting_trainer_msgs.msg import Contact, ForceSample, FrameInputs, Mesh, MeshDelta
from cutting_trainer_msgs.srv import Cut, GetMesh
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from tissue_sim import messages, ros
from tissue_sim.assembly import make_simulation
from tissue_sim.contact import Command, Frame, ToolContact
from tissue_sim.errors import MeshError
from tissue_sim.mesh import Touched
from tissue_sim.parameters import scene_parameter, seed_parameter
from tissue_sim.plan_watch import PlanWatch
from tissue_sim.scene_file import read_section
from tissue_sim.settings import TissueSettings
from tissue_sim.timing import PeriodicLoop
from tissue_sim.tool_contact import tool_contact

_CONTACT_AGE_NS = 100_000_000
_KEYFRAME_SECONDS = 5.0
_CUT_TIMEOUT_NS = 1_000_000_000


class TissueSimNode(Node):
    """Owns the tissue; see docs/architecture.md for its topics."""

    def __init__(self) -> None:
        super().__init__('tissue_sim')
        scene = Path(scene_parameter(self))
        seed_parameter(self)
        settings = read_section(scene, 'tissue', TissueSettings)
        self._scene = scene.stem
        self._simulation, plan = make_simulation(settings)
        self._plan = None if plan is None else PlanWatch(plan, self._simulation)
        self._log_plan()
        self._loop = PeriodicLoop(settings.integration.rate)
        self._encoder = messages.DeltaEncoder(self._simulation.mesh, self._simulation.displacement)
        self._lock = threading.Lock()
        self._rejected: Counter[str] = Counter()
        self._contact: Contact | None = None
        self._contact_received = 0
        self._touched: Touched | None = None
        self._cut: Any = None
        self._cut_sent = 0
        self._cut_step = 0
        self._answer = FrameInputs.NO_ANSWER
        self._next_keyframe = 0.0
        self._frame: Frame | None = None
        self._connect()

    def _log_plan(self) -> None:
        if self._plan is None:
            return
        for sentence in self._plan.announcement():
            self.get_logger().info(sentence)
        if self._plan.unmet:
            self.get_logger().warning(self._plan.unmet)

    def _connect(self) -> None:
        self._mesh_publisher = self.create_publisher(Mesh, ros.MESH, ros.LATCHED)
        self._updates = self.create_publisher(MeshDelta, ros.MESH_UPDATES, ros.UPDATES)
        self._forces = self.create_publisher(ForceSample, ros.FORCE, ros.STREAM)
        self._inputs = self.create_publisher(FrameInputs, ros.FRAME_INPUTS, ros.STREAM)
        self._contacts = ros.polled(self, Contact, ros.CONTACT, ros.NEWEST_BEST_EFFORT)
        self._cutting = self.create_client(Cut, ros.CUT)
        service = self.create_service(GetMesh, ros.GET_MESH, self._serve_mesh)
        ros.introspect(self, service, contents=False)  # whole meshes are in the bag as it is
        self._diagnostics = ros.Diagnostics(self, self._status)

    def work(self, stop: ros.Stop) -> None:
        """Runs frames to the end."""
        with self._lock:
            self._publish_keyframe()
        ros.announce_ready(self)
        self._loop.start()
        while not stop.is_set():
            self._loop.wait()
            with self._lock:
                self._tick()

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
        delta = self._encoder.encode(
            self._simulation.displacement, frame.step, now, self._touched, self._cut_step
        )
        self._touched = None
        self._frame = frame
        if not frame.diverged:
            self._forces.publish(
                messages.force_message(
                    frame,
                    self._encoder.revision,
                    self._simulation.mesh.topology,
                    used,
                    now,
                )
            )
        else:
            self._rejected['diverged frame'] += 1
        if frame.trouble:
            self.get_logger().error(frame.trouble, throttle_duration_sec=1.0)
        if delta is not None:
            self._updates.publish(delta)
        if time.monotonic() >= self._next_keyframe:
            self._publish_keyframe()
        if frame.command is not None:
            self._ask(frame)

    def _newest_contact(self) -> ToolContact | None:
        message = ros.take(self._contacts)
        now = time.monotonic_ns()
        if message is not None:
            self._contact, self._contact_received = message, now
        if self._contact is None or now - self._contact_received > _CONTACT_AGE_NS:
            return None
        try:
            return tool_contact(self._contact, self._simulation.mesh.node_count)
        except ValueError as error:
            self._reject('contact', str(error))
            return None

    def _reject(self, what: str, why: str) -> None:
        self._rejected[what] += 1
        self.get_logger().warning(f'{what} refused: {why}', throttle_duration_sec=1.0)

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
            self._lose_cut('the service cutting/cut is not there')
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
                self._lose_cut('no answer within 1 s')
            return
        response, self._cut = self._cut.result(), None
        try:
            if response.error_code == Cut.Response.INVALID_SWEEP:
                self._simulation.cut_done()
                self._answer = FrameInputs.REFUSED
                self._reject('cut', f'{response.error_msg}: this sweep stays uncut')
                return
            if not response.success:
                raise ValueError(response.error_msg)
            if response.topology != self._simulation.mesh.topology:
                raise ValueError(f'it is for topology {response.topology}')
            delta = messages.delta_from(response)
            if delta.empty:
                self._simulation.cut_done()
                self._answer = FrameInputs.EMPTY
            else:
                self._touched = self._simulation.apply_cut(delta)
                self._answer = FrameInputs.APPLIED
        except (ValueError, MeshError) as error:
            self._lose_cut(str(error))

    def _lose_cut(self, why: str) -> None:
        self._simulation.cut_failed()
        self._answer = FrameInputs.LOST
        self._reject('cut', why)

    def _publish_keyframe(self) -> None:
        self._mesh_publisher.publish(self._mesh_message())
        self._next_keyframe = time.monotonic() + _KEYFRAME_SECONDS

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
        }
        values |= self._plan.values() if self._plan else {}
        values |= {f'refused {what}': count for what, count in self._rejected.items()}
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
        return DiagnosticStatus.OK, frame.state.name.lower(), values


def main() -> None:
    """Runs the node."""
    ros.run(TissueSimNode, TissueSimNode.work)


if __name__ == '__main__':
    main()
