"""The node `cutting`: the service that turns a sweep of the blade into a change of connectivity."""

import time
from collections import Counter, deque
from pathlib import Path

import numpy as np
from cutting_trainer_msgs.msg import CutReport, Mesh, MeshDelta
from cutting_trainer_msgs.srv import Cut, GetMesh
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from cutting.method import CutResult, SweepError, check_sweep
from cutting.methods import make_method
from cutting.settings import CuttingSettings
from cutting.warm_up import warm_up
from tissue_sim import ros
from tissue_sim.blade import Sweep
from tissue_sim.errors import MeshError
from tissue_sim.mesh import TetMesh
from tissue_sim.messages import delta_into, packed
from tissue_sim.parameters import scene_parameter, seed_parameter
from tissue_sim.replica import MeshReplica
from tissue_sim.scene_file import read_section

_REMEMBERED = 16
_PATIENCE = 0.25
"""How long [s] a request waits for the delta that it has overtaken."""
_ASK_AGAIN = 1.0
"""[s] after which a whole mesh that was asked for and did not come is asked for again."""


class CuttingNode(Node):
    """Keeps a replica of the tissue and what the method remembers; see docs/cutting.md."""

    def __init__(self) -> None:
        super().__init__('cutting')
        scene = Path(scene_parameter(self))
        seed_parameter(self)
        self._settings = read_section(scene, 'cutting', CuttingSettings)
        warm_up(self._settings)
        self._method = make_method(self._settings)
        self._replica = MeshReplica()
        self._mesh: TetMesh | None = None
        self._displacements: deque[tuple[int, np.ndarray]] = deque(maxlen=_REMEMBERED)
        self._asked = -_ASK_AGAIN
        self._counts: Counter[str] = Counter()
        self._slowest = 0.0
        self.create_subscription(Mesh, ros.MESH, self._take_mesh, ros.LATCHED)
        self._deltas = self.create_subscription(
            MeshDelta, ros.MESH_UPDATES, self._take_delta, ros.UPDATES
        )
        self._get_mesh = self.create_client(GetMesh, ros.GET_MESH)
        ros.introspect(self, self.create_service(Cut, ros.CUT, self._serve))
        self._diagnostics = ros.Diagnostics(self, self._status)
        ros.announce_ready(self)

    def _take_mesh(self, message: Mesh) -> None:
        # A step that goes back is a new tissue_sim. Any other keyframe is passed over: to load one
        # that overtakes its deltas would drop the stroke; a missing delta shows in the next one.
        if self._mesh is None or message.step < self._replica.step:
            self._load(message)

    def _load(self, message: Mesh) -> None:
        try:
            self._replica.load(message)
        except ValueError as error:
            self._refuse('mesh', str(error))
            return
        self._rebuild('a full mesh was loaded')

    def _rebuild(self, why: str) -> None:
        self._method.abort()
        self._displacements.clear()
        try:
            self._mesh = TetMesh(self._replica.rest, self._replica.tetrahedra, self._replica.fixed)
        except MeshError as error:
            self._mesh = None
            self._refuse('mesh', str(error))
            return
        self._mesh.topology = self._replica.topology
        self._mesh.set_kinds(self._replica.triangles, self._replica.triangle_kind)
        self._remember()
        self._counts['rebuilt'] += 1
        self.get_logger().info(f'mesh of {len(self._mesh.tetrahedra)} tetrahedra: {why}')

    def _take_delta(self, message: MeshDelta) -> None:
        if self._mesh is None:
            return
        try:
            if not self._replica.apply(message):
                self._ask_for_mesh()
                return
        except ValueError as error:
            self._refuse('mesh delta', str(error))
            self._ask_for_mesh()
            return
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
        return time.monotonic() - self._asked < _ASK_AGAIN

    def _ask_for_mesh(self) -> None:
        if self._asking or not self._get_mesh.service_is_ready():
            return
        self._asked = time.monotonic()
        self._counts['mesh fetched'] += 1
        self._get_mesh.call_async(GetMesh.Request()).add_done_callback(self._got_mesh)

    def _got_mesh(self, future) -> None:  # type: ignore[no-untyped-def]
        self._asked = -_ASK_AGAIN
        response = future.result()
        if response is not None and response.success:
            self._load(response.mesh)

    def _serve(self, request: Cut.Request, response: Cut.Response) -> Cut.Response:
        self._catch_up(request.revision)
        begun = time.perf_counter()
        response.revision = request.revision
        try:
            code, result = self._cut(request)
        except SweepError as error:
            code, result = (Cut.Response.INVALID_SWEEP, str(error)), None
        except (MeshError, AssertionError, ValueError, KeyError, IndexError) as error:
            self.get_logger().error(f'cut refused: {type(error).__name__}: {error}')
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
            self._refuse('cut', response.error_msg)
        self._slowest = max(self._slowest, time.perf_counter() - begun)
        return response

    def _catch_up(self, revision: int) -> None:
        """Takes the deltas up to a revision: a request may overtake the one it belongs to."""
        deadline = time.monotonic() + _PATIENCE
        while self._mesh is not None and self._replica.revision < revision and not self._asking:
            delta = ros.take(self._deltas)
            if delta is not None:
                self._take_delta(delta)
            elif time.monotonic() > deadline:
                return
            else:
                time.sleep(0.0005)

    def _cut(self, request: Cut.Request) -> tuple[tuple[int, str], CutResult | None]:
        if self._mesh is None:
            return (Cut.Response.NOT_READY, 'no mesh has come yet on tissue/mesh'), None
        displacement = dict(self._displacements).get(request.revision)
        if displacement is None or len(displacement) != len(self._replica.rest):
            first, last = self._displacements[0][0], self._displacements[-1][0]
            text = f'revision {request.revision} is not at hand; revisions {first} to {last} are'
            text += ', and the whole mesh has been asked for' if self._asking else ''
            return (Cut.Response.WRONG_REVISION, text), None
        if self._mesh.topology != self._replica.topology:
            # Who asks has been given the last answer, or has given it up: what it knows counts.
            self._rebuild('the last change was not taken over')
        if self._mesh is None:
            return (Cut.Response.NOT_READY, 'the mesh could not be used'), None
        positions = self._mesh.rest + displacement
        if request.command == Cut.Request.ABORT:
            self._method.abort()
            return (Cut.Response.OK, ''), CutResult.nothing()
        if request.command == Cut.Request.FINISH:
            result = self._method.finish(self._mesh, positions)
        elif request.command == Cut.Request.ADVANCE:
            sweep = Sweep(request.root_from, request.tip_from, request.root_to, request.tip_to)
            check_sweep(sweep)
            result = self._method.advance(self._mesh, positions, sweep)
        else:
            text = f'command {request.command} is none of ADVANCE 0, FINISH 1, ABORT 2'
            return (Cut.Response.INVALID_SWEEP, text), None
        if not result.delta.empty:
            self._mesh.apply(result.delta)
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

    def _refuse(self, what: str, why: str) -> None:
        self._counts[f'refused {what}'] += 1
        self.get_logger().warning(f'{what} refused: {why}', throttle_duration_sec=1.0)

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
    """Runs the node."""
    ros.run(CuttingNode)


if __name__ == '__main__':
    main()
