"""The node `cutting`: a service that turns a sweep of the blade into a change of connectivity."""

import time
from collections import Counter, deque
from pathlib import Path

import numpy as np
from cutting_trainer_msgs.msg import CutReport, Mesh, MeshDelta, State
from cutting_trainer_msgs.srv import Cut, GetMesh
from diagnostic_msgs.msg import DiagnosticStatus

from cutting_trainer.cutting.memory import MethodState
from cutting_trainer.cutting.method_interface import FAILURES, CutResult, SweepError, carry_out
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.cutting.warm_up import warm_up
from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.node_common.lifecycle import ManagedNode, Stop, run
from cutting_trainer.node_common.parameters import (
    scene_parameter,
    seed_parameter,
)
from cutting_trainer.node_common.rejections import MessageError, require_frame, require_tool
from cutting_trainer.node_common.scene_reader import read_section, tool_names
from cutting_trainer.node_common.stamps import REVISION_MODULUS
from cutting_trainer.node_common.timing import FRAME_NICENESS, request_preference
from cutting_trainer.tissue_sim.contact.blade import Sweep
from cutting_trainer.tissue_sim.contact.tool import CutCommand
from cutting_trainer.tissue_sim.mesh.replica import BYTES_PER_NODE, MeshReplica
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, carried_over, grown
from cutting_trainer.tissue_sim.streaming.mesh_follower import max_nodes_parameter
from cutting_trainer.tissue_sim.streaming.messages import delta_into, mesh_message, packed
from cutting_trainer.tissue_sim.streaming.state_publisher import StatePublisher

_KEPT_DISPLACEMENTS = 16
_REVISION_TIMEOUT_S = 0.25
"""Time that a request waits for the delta it has overtaken."""
_MAX_DELTAS_AHEAD = 150
"""Deltas that a request may have overtaken; a request farther ahead does not wait."""
_MESH_REPLY_TIMEOUT_S = 1.0
"""Time after which a request for the full mesh is repeated."""


_REASONS = {
    Cut.Response.WRONG_REVISION: 'wrong revision',
    Cut.Response.INVALID_SWEEP: 'invalid sweep',
    Cut.Response.NOT_READY: 'not ready',
    Cut.Response.INTERNAL: 'the cut failed',
}
"""Reasons of rejected requests, by the code of the response."""


class CuttingNode(ManagedNode):
    """Serves cuts with a replica of the tissue and the state of the method; see docs/cutting.md."""

    def __init__(self) -> None:
        super().__init__('cutting')

    def configure(self) -> None:
        """Read the scene, set up the method and the service."""
        scene = Path(scene_parameter(self))
        seed_parameter(self)
        self._settings = read_section(scene, 'cutting', CuttingSettings)
        self._tools = 1 + len(tool_names(scene))
        warm_up(self._settings)
        self._method = make_method(self._settings)
        most = max_nodes_parameter(self)
        self._replica, self._largest = MeshReplica(most), BYTES_PER_NODE * most
        self._mesh: TetMesh | None = None
        self._displacements: deque[tuple[int, np.ndarray]] = deque(maxlen=_KEPT_DISPLACEMENTS)
        self._ahead: np.ndarray | None = None  # displacement after the last answer
        self._asked = -_MESH_REPLY_TIMEOUT_S
        self._counts: Counter[str] = Counter()
        self._slowest = 0.0
        most = self._largest
        ros.listen(self, Mesh, ros.MESH, self._take_mesh, qos.LATCHED, most=most)
        self._deltas = ros.listen(
            self, MeshDelta, ros.MESH_UPDATES, self._take_delta, qos.UPDATES, most=most
        )
        states = self.create_publisher(State, ros.CUTTING_STATE, qos.STREAM)
        self._states = StatePublisher(states)
        self._get_mesh = self.create_client(GetMesh, ros.GET_MESH)
        ros.introspect(self, self.create_service(Cut, ros.CUT, self._serve))
        self.create_service(GetMesh, ros.MESH_RECOVERY_SERVICES[0], self._serve_mesh)
        self._diagnostics = ros.Diagnostics(self, self._status)

    def work(self, stop: Stop) -> None:
        """Serve with the scheduling preference of the simulation: its frames wait for the
        answers.
        """
        self.get_logger().info(request_preference(FRAME_NICENESS))
        super().work(stop)

    def release(self) -> None:
        """Wait until a state is published."""
        self._states.close()

    def _take_mesh(self, message: Mesh) -> None:
        require_frame(ros.MESH, message.header.frame_id)
        # A step that goes back is from a new tissue_sim. Other keyframes are ignored: loading one
        # that overtakes its deltas would drop the stroke. A missing delta shows in the next one.
        if self._mesh is None or message.step < self._replica.step:
            self._load(message)

    def _load(self, message: Mesh) -> None:
        self._replica.load(message)
        self._rebuild('a full mesh was loaded')

    def _rebuild(self, why: str) -> None:
        self._method.abort()
        self._displacements.clear()
        self._ahead = None
        try:
            self._mesh = self._replica.mesh()
        except MeshError as error:
            self._mesh = None
            self.rejections.add(ros.MESH, error)
            return
        self._remember()
        self._counts['rebuilt'] += 1
        self.get_logger().info(
            f'mesh of {len(self._mesh.tetrahedra)} tetrahedra: {why}', throttle_duration_sec=0.5
        )

    def _take_delta(self, message: MeshDelta) -> None:
        if self._mesh is None:
            return
        require_frame(ros.MESH_UPDATES, message.header.frame_id)
        try:
            if not self._replica.apply(message):
                self._ask_for_mesh()
                return
        except MessageError:
            self._ask_for_mesh()
            raise
        if message.cut_step and not self._same_mesh():
            self._rebuild('a cut was applied that this node did not make last')
        self._remember()

    def _same_mesh(self) -> bool:
        mesh, replica = self._mesh, self._replica
        assert mesh is not None
        return (
            mesh.topology == replica.topology
            and np.array_equal(mesh.tetrahedra, replica.tetrahedra)
            and np.array_equal(mesh.rest, replica.rest)
        )

    def _remember(self) -> None:
        self._displacements.append((self._replica.revision, self._replica.displacement.copy()))

    @property
    def _asking(self) -> bool:
        return time.monotonic() - self._asked < _MESH_REPLY_TIMEOUT_S

    def _ask_for_mesh(self) -> None:
        if self._asking or not self._get_mesh.service_is_ready():
            return
        self._asked = time.monotonic()
        self._counts['mesh fetched'] += 1
        self._get_mesh.call_async(GetMesh.Request()).add_done_callback(self._receive_mesh)

    def _receive_mesh(self, future) -> None:  # type: ignore[no-untyped-def]
        self._asked = -_MESH_REPLY_TIMEOUT_S
        response = future.result()
        if response is not None and response.success:
            try:
                self._load(response.mesh)
            except MessageError as error:
                self.rejections.add(ros.GET_MESH, error)

    def _serve(self, request: Cut.Request, response: Cut.Response) -> Cut.Response:
        if not self.is_active:
            response.error_code = Cut.Response.NOT_READY
            response.error_msg = 'the node cutting is not active: activate it'
            return response
        self._catch_up(request.revision)
        begun = time.perf_counter()
        response.revision = request.revision
        try:
            code, result = self._cut(request)
        except SweepError as error:
            code, result = (Cut.Response.INVALID_SWEEP, str(error)), None
        except FAILURES as error:
            self._rebuild('a cut failed')
            code, result = (Cut.Response.INTERNAL, f'{type(error).__name__}: {error}'), None
        response.success = code[0] == Cut.Response.OK
        response.error_code, response.error_msg = code
        if result is not None and self._mesh is not None:
            response.topology = self._replica.topology
            delta_into(response, result.delta)
            response.report = self._report(result, time.perf_counter() - begun)
            self._counts['cuts'] += 1
        else:
            self.rejections.add(ros.CUT, MessageError(_REASONS[code[0]], response.error_msg))
        self._slowest = max(self._slowest, time.perf_counter() - begun)
        return response

    def _serve_mesh(self, _: GetMesh.Request, response: GetMesh.Response) -> GetMesh.Response:
        """Return the tissue with the last answered cut, for a new `tissue_sim`."""
        mesh, replica = self._mesh, self._replica
        if mesh is None:
            return response
        displacement, revision = replica.displacement, replica.revision
        if mesh.topology != replica.topology and self._ahead is not None:
            displacement, revision = self._ahead[: mesh.node_count], revision + 1
        self._method.abort()
        now = time.time_ns()
        response.mesh = mesh_message(mesh, displacement, '', revision, replica.step, now)
        response.success = True
        return response

    def _catch_up(self, revision: int) -> None:
        """Apply the deltas up to a revision: a request may overtake its delta."""
        deadline = time.monotonic() + _REVISION_TIMEOUT_S
        while self._mesh is not None and self._overtaken(revision) and not self._asking:
            if time.monotonic() > deadline:
                return
            try:
                if (delta := ros.take(self._deltas, self._largest)) is None:
                    time.sleep(0.0005)
                else:
                    self._take_delta(delta)
            except MessageError as error:
                self.rejections.add(ros.MESH_UPDATES, error)

    def _overtaken(self, revision: int) -> bool:
        """Return whether the deltas up to a revision are on their way."""
        ahead = (revision - self._replica.revision) % REVISION_MODULUS
        return 0 < ahead <= _MAX_DELTAS_AHEAD

    def _cut(self, request: Cut.Request) -> tuple[tuple[int, str], CutResult | None]:
        if self._mesh is None:
            return (Cut.Response.NOT_READY, 'no mesh has come yet on tissue/mesh'), None
        try:
            require_tool('Cut', request.tool, count=self._tools)
        except MessageError as error:
            return (Cut.Response.INVALID_SWEEP, str(error)), None
        if request.command == Cut.Request.ABORT:
            self._rebuild('the requester aborted the stroke')
            return (Cut.Response.OK, ''), CutResult.nothing()
        displacement = dict(self._displacements).get(request.revision)
        if displacement is None or len(displacement) != len(self._replica.rest):
            if (request.revision - self._replica.revision) % REVISION_MODULUS > _MAX_DELTAS_AHEAD:
                self._ask_for_mesh()  # the revision of this replica may be invalid
            first, last = self._displacements[0][0], self._displacements[-1][0]
            text = f'revision {request.revision} is not at hand; revisions {first} to {last} are'
            text += ', and the whole mesh has been asked for' if self._asking else ''
            return (Cut.Response.WRONG_REVISION, text), None
        if self._mesh.topology != self._replica.topology:
            # The requester has applied the last answer or dropped it: its mesh counts.
            self._rebuild('the last change was not applied')
        if self._mesh is None:
            return (Cut.Response.NOT_READY, 'the mesh could not be used'), None
        positions = self._mesh.rest + displacement
        if request.command == Cut.Request.STATE:
            self._states.publish(MethodState(self._method, self._mesh).state(), request.step)
            return (Cut.Response.OK, ''), CutResult.nothing()
        if request.command not in list(CutCommand):
            text = f'command {request.command} is none of ADVANCE 0, FINISH 1, ABORT 2, STATE 3'
            return (Cut.Response.INVALID_SWEEP, text), None
        sweep = Sweep(request.root_from, request.tip_from, request.root_to, request.tip_to)
        result = carry_out(self._method, self._mesh, positions, CutCommand(request.command), sweep)
        if not result.delta.empty:
            count = self._mesh.node_count
            touched = self._mesh.apply(result.delta)
            self._ahead = grown(displacement.copy(), count + len(result.delta.node_parents))
            carried_over(self._ahead, count, result.delta, touched)
        return (Cut.Response.OK, ''), result

    def _report(self, result: CutResult, seconds: float) -> CutReport:
        report, delta = result.report, result.delta
        return CutReport(
            method=self._settings.method,
            touched=report.touched,
            removed=len(delta.removed_tetrahedra),
            added=len(delta.tetrahedra),
            new_nodes=len(delta.node_parents),
            cases=packed('I', report.cases),
            area=report.area,
            removed_volume=report.removed_volume,
            worst_altitude=report.worst_altitude,
            duration=seconds,
            warnings=list(report.warnings),
        )

    def _status(self) -> tuple[bytes, str, dict[str, object]]:
        values: dict[str, object] = dict(self._counts)
        values |= {
            'method': self._settings.method,
            'revision': self._replica.revision,
            'slowest_cut': self._slowest,
        }
        if self._mesh is None:
            return DiagnosticStatus.WARN, 'waiting for tissue/mesh', values
        return DiagnosticStatus.OK, 'ready', values


def main() -> None:
    """Run the node."""
    run(CuttingNode)


if __name__ == '__main__':
    main()
