"""The node `tissue_sim`: simulates the tissue at 30 Hz."""

import os
import time
from pathlib import Path

from cutting_trainer_msgs.msg import FreePiece, Mesh, MeshDelta, State
from cutting_trainer_msgs.srv import GetMesh
from diagnostic_msgs.msg import DiagnosticStatus
from std_srvs.srv import Trigger

from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.code_identity import identity_here
from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.node_common.lifecycle import ManagedNode, Stop, announce_ready, run
from cutting_trainer.node_common.parameters import (
    announced,
    parameter,
    scene_parameter,
    seed_parameter,
)
from cutting_trainer.node_common.scene_reader import read_section, tool_names
from cutting_trainer.node_common.stamps import REVISION_MODULUS, newer
from cutting_trainer.node_common.timing import (
    FRAME_NICENESS,
    FairLock,
    PeriodicLoop,
    request_preference,
)
from cutting_trainer.tissue_sim.assembly import as_planned, make_simulation
from cutting_trainer.tissue_sim.contact.tool import Frame
from cutting_trainer.tissue_sim.mesh.pieces import PieceRegister
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica
from cutting_trainer.tissue_sim.motion.far_field import SHARES
from cutting_trainer.tissue_sim.motion.parallel_euler import PARALLEL, ParallelEuler
from cutting_trainer.tissue_sim.planner.monitor import PlanMonitor
from cutting_trainer.tissue_sim.scene_schema import TissueSettings
from cutting_trainer.tissue_sim.simulation.checkpoint import Checkpoint, read_checkpoint
from cutting_trainer.tissue_sim.simulation.governor import Governor
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.simulation.state import state_of
from cutting_trainer.tissue_sim.streaming import messages
from cutting_trainer.tissue_sim.streaming.cut_client import CutClient
from cutting_trainer.tissue_sim.streaming.link_budget import LinkBudget
from cutting_trainer.tissue_sim.streaming.mesh_recovery import recover_meshes
from cutting_trainer.tissue_sim.streaming.state_publisher import StatePublisher
from cutting_trainer.tissue_sim.streaming.tool_topics import ToolTopics

_KEYFRAME_PERIOD_S = 5.0
_MIN_STALL_S = 1.0
"""Time between two frames after which another node may have replaced this one."""
_NAMESAKE_CHECK_S = 5.0
"""Time after a stall in which it looks for a replacement."""
_CHECKPOINT_PERIOD_S = 0.5
"""Between two checkpoints of the mesh due to cuts."""
_DISCOVERY_S = 0.5
"""Time in which a running recorder discovers a new topic and subscribes to it."""


class TissueSimNode(ManagedNode):
    """Owner of the tissue; see docs/architecture.md for its topics."""

    def __init__(self) -> None:
        super().__init__('tissue_sim')

    def configure(self) -> None:
        """Read the scene, set up the tissue and the topics."""
        scene = Path(scene_parameter(self))
        seed_parameter(self)
        text = 'continue with the tissue known to its followers, in the place of a node that died'
        self._resumes = bool(parameter(self, 'resume', False, text))
        settings = read_section(scene, 'tissue', TissueSettings)
        labels = ('', *tool_names(scene))
        self._updates = self.create_publisher(MeshDelta, ros.MESH_UPDATES, qos.UPDATES)
        self._tools = [ToolTopics(self, number, label) for number, label in enumerate(labels)]
        self._announced = time.monotonic()
        self._scene = scene.stem
        text = 'checkpoint file of the tissue, for a replacement of this node'
        file = str(parameter(self, 'checkpoint', '', text))
        self._file = Path(file) if file else None
        before = self._tissue_before() if self._resumes else None
        self._checkpoint = Checkpoint(self._file) if self._file else None
        simulation, plan = make_simulation(settings, before, self.get_logger().info, len(labels))
        self._settings, self._found = as_planned(settings, plan), plan
        self._take(simulation, 0 if before is None else before.revision)
        self._anew: TissueSimulation | None = None
        self._log_plan()
        self._check_processors(settings.budget.threads)
        self._announce_method(self._settings)
        text = 'largest data rate of meshes and their deltas [bytes/s]; 0: no limit'
        self._link = LinkBudget(
            float(parameter(self, 'mesh_bandwidth', 0.0, text, within=(0.0, 1e12)))
        )
        self._loop = PeriodicLoop(settings.integration.rate)
        self._lock = FairLock()
        self._next_keyframe = self._next_checkpoint = 0.0
        self._ticked = self._suspects = 0.0
        self._diverged = 0
        self._connect()

    def _take(self, simulation: TissueSimulation, revision: int) -> None:
        """Use a simulation before its first frame, with the revision of its published mesh."""
        self._simulation = simulation
        self._plan = None if self._found is None else PlanMonitor(self._found, simulation)
        period = 1 / self._settings.integration.rate
        self._governor = Governor(period, simulation.dynamics.possible_concessions)
        self._encoder = messages.DeltaEncoder(simulation.mesh, simulation.displacement)
        self._encoder.revision = revision
        self._pieces = PieceRegister(simulation.mesh)
        self._looked_at = simulation.mesh.topology
        self._frame: Frame | None = None

    def _tissue_before(self) -> MeshReplica | None:
        """Return the tissue of the previous node of this name, as its followers know it."""
        newest = MeshReplica()
        for mesh in (*recover_meshes(self), *(read_checkpoint(self._file) if self._file else [])):
            if newer(mesh.revision, newest.revision):
                newest.load(mesh)
        if newest.revision < 0:
            self.get_logger().warning('nobody knows the tissue as it was: it begins whole')
            return None
        self.get_logger().warning(
            f'goes on with the tissue as it was: from frame {newest.step}, '
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

    def _check_processors(self, threads: int) -> None:
        """Say whether the cores of the scene's budget are used, and are there."""
        processors, asked = len(os.sched_getaffinity(0)), f'tissue.budget.cores is {threads}'
        if threads > 1 and not self._simulation.dynamics.parallel:
            by = self._simulation.dynamics.stepping.integrator
            self.get_logger().warning(
                f'{asked}, and one thread computes this tissue by {by}: several share only steps '
                f'of {" and ".join(PARALLEL)}, from {ParallelEuler.min_nodes} moving nodes on'
            )
        elif threads > processors == 1:
            self.get_logger().warning(
                f'{asked}, and one processor is left to this node: one thread computes, and takes '
                'about a quarter longer than with 1. Set it to 1, or take more processors'
            )
        elif threads > processors:
            self.get_logger().warning(
                f'{asked}, and {processors} processors are left to this node: so many threads '
                'compute'
            )

    def _announce_method(self, taken: TissueSettings) -> None:
        """Publish the method of computation; a re-simulation of the bag uses it."""
        for name, value in taken.method_taken.items():
            announced(self, name, value, f'tissue.{name} used by the simulation')
        for name, text in identity_here().flat().items():
            announced(self, name, text, 'code, library or processor that computes the tissue')

    def _connect(self) -> None:
        self._mesh_publisher = self.create_publisher(Mesh, ros.MESH, qos.LATCHED)
        self._free_pieces = self.create_publisher(FreePiece, ros.PIECES, qos.HISTORY)
        for tool in self._tools:
            tool.connect()
        self._cuts = CutClient(self, self._simulation, self.rejections)
        states = self.create_publisher(State, ros.TISSUE_STATE, qos.STREAM)
        self._states = StatePublisher(states)
        service = self.create_service(GetMesh, ros.GET_MESH, self._serve_mesh)
        ros.introspect(self, service, contents=False)  # the bag has whole meshes anyway
        ros.introspect(self, self.create_service(Trigger, ros.RESET_TISSUE, self._serve_reset))
        self._diagnostics = ros.Diagnostics(self, self._status)

    @property
    def progress(self) -> int:
        """Number of cycles of its loop."""
        return self._loop.ticks

    def work(self, stop: Stop) -> None:
        """Run frames until the end."""
        self.get_logger().info(request_preference(FRAME_NICENESS))
        self._await_recorder(stop)
        with self._lock:
            self._publish_keyframe()
        announce_ready(self)
        self._loop.start()
        self._ticked = time.monotonic()
        while not stop.is_set() and not self.ended:
            late = self._loop.wait() * 1e-9
            self._yield_place()
            self._cuts.wait(stop.is_set, self._diagnostics.catch_up)
            self._ticked = time.monotonic()  # a wait is no stall
            if stop.is_set():
                return
            with self._lock:
                if self._anew is not None:
                    self._begin_anew(self._anew)
                self._tick()
            self._govern(time.monotonic() - self._ticked, late)
            self._diagnostics.catch_up()

    def _await_recorder(self, stop: Stop) -> None:
        """Wait until a recorder has found inputs, forces and meshes of frames: only a complete
        record can be re-simulated.
        """
        until = self._announced + _DISCOVERY_S
        while time.monotonic() < until and not self._is_recorded():
            if stop.is_set():
                return
            time.sleep(0.005)

    def _is_recorded(self) -> bool:
        meshes = self._updates.get_subscription_count() > 0
        return meshes and all(tool.is_recorded for tool in self._tools)

    def release(self) -> None:
        """Stop the threads of state and checkpoint."""
        self._states.close()
        if self._checkpoint is not None:
            self._checkpoint.close()

    def _tick(self) -> None:
        resolved = self._cuts.take()
        touched = resolved.touched
        is_recorded = self._publish_state()
        mesh = self._simulation.mesh
        contacts = (tool.contact(mesh) for tool in self._tools)
        frame = self._simulation.frame(*contacts, concession=self._governor.concession)
        felt = list(zip(self._tools, frame.by_tool, strict=True))
        over = self._plan.follow(frame) if self._plan else ''
        if over:
            self.get_logger().warning(over, throttle_duration_sec=5.0)
        now = time.time_ns()
        for tool, one in felt:
            tool.publish_inputs(one, resolved, now)
        delta = None
        if touched is not None or frame.command is not None or self._link.allows(now * 1e-9):
            delta = self._encoder.encode(
                self._simulation.displacement, frame.step, now, touched, resolved.cut_step
            )
        if touched is not None and time.monotonic() >= self._next_checkpoint:
            self._keep(self._mesh_message())
        self._frame = frame
        for tool, one in felt:
            tool.publish_force(one, self._encoder.revision, mesh.topology, now)
        self._tell_pieces(frame)
        self._diverged += frame.diverged
        if frame.trouble:
            self.get_logger().error(frame.trouble, throttle_duration_sec=1.0)
        if delta is not None:
            self._updates.publish(delta)
            self._link.spend(delta)
        if is_recorded or time.monotonic() >= self._next_keyframe:
            self._publish_keyframe()
        if is_recorded:
            self._cuts.request_state(self._encoder.revision, frame.step)
        self._cuts.ask(frame, self._encoder.revision)

    def _govern(self, spent: float, late: float) -> None:
        """Decide what the next frame concedes, and say where that changes."""
        before = self._governor.concession
        self._governor.follow(spent, late)
        now = self._governor.concession
        if now == before:
            return
        if now > before:
            said = f'frames come late: {_moving(now)} from now on, until there is time again'
            self.get_logger().warning(said)
        else:
            self.get_logger().info(f'frames are in time: {_moving(now)} again')

    def _tell_pieces(self, frame: Frame) -> None:
        """Publish the pieces that came off, once the blade has left the tissue."""
        simulation = self._simulation
        mesh = simulation.mesh
        if simulation.blade is not None or mesh.topology == self._looked_at:
            return
        self._looked_at = mesh.topology
        for piece in self._pieces.find_new(mesh, simulation.positions):
            mass = piece.volume * simulation.material.density
            if len(mesh.regions):
                own = self._pieces.nodes_of(piece.number)
                mass = float(simulation.model.mass[own].sum())
            self._free_pieces.publish(
                messages.piece_message(piece, mass, frame.step, mesh.topology, time.time_ns())
            )

    def _publish_state(self) -> bool:
        """Publish the whole state for a recorder that came within the session; return whether it
        was due.
        """
        simulation = self._simulation
        if not self._states.is_wanted() or simulation.awaits_answer:
            return False
        self._states.publish(state_of(simulation), simulation.step + 1)
        return True

    def _publish_keyframe(self) -> None:
        message = self._mesh_message()
        self._mesh_publisher.publish(message)
        self._link.spend(message)
        self._keep(message)
        self._next_keyframe = time.monotonic() + _KEYFRAME_PERIOD_S

    def _keep(self, message: Mesh) -> None:
        if self._checkpoint is not None:
            self._checkpoint.offer(message)
            self._next_checkpoint = time.monotonic() + _CHECKPOINT_PERIOD_S

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

    def _serve_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Set up the whole tissue, with which the loop goes on."""
        if not self.is_active:
            response.message = 'The node tissue_sim is not active: activate it.'
            return response
        try:
            self._anew, _ = make_simulation(self._settings, tools=len(self._tools))
        except MeshError as error:
            response.message = f'The mesh of the scene cannot be used any more: {error}.'
            return response
        response.success, response.message = True, 'The tissue is whole from its next frame on.'
        return response

    def _begin_anew(self, simulation: TissueSimulation) -> None:
        """Go on as a process would that begins with the whole tissue; revisions go on."""
        self._anew = None
        self.get_logger().info(f'the tissue is whole again, after frame {self._simulation.step}')
        self._take(simulation, (self._encoder.revision + 1) % REVISION_MODULUS)
        self._cuts.follow(simulation)
        self._publish_keyframe()

    def _yield_place(self) -> None:
        """Exit if another node has replaced this one during a stall."""
        late = time.monotonic() - self._ticked
        self._ticked = time.monotonic()
        if late > _MIN_STALL_S:
            self._suspects = self._ticked + _NAMESAKE_CHECK_S
        if self._ticked < self._suspects and self._namesakes() > 1:
            self.get_logger().error(
                f'stood still for {late:.1f} s, and another tissue_sim has its place now: ends'
            )
            self.ended = True

    def _namesakes(self) -> int:
        """Return the number of nodes of this name that publish the mesh.

        The followers take care of nodes of other names.
        """
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
            'omega_bound': simulation.dynamics.masses.omega,
            'step_bound': simulation.dynamics.time_steps.bound(),
            'active_nodes': simulation.dynamics.active_nodes,
            'threads': simulation.dynamics.threads,
            'inverted': simulation.dynamics.inverted,
            'concession': self._governor.concession,
            'mesh_bytes': self._link.sent,
            'deltas_held_back': self._link.held_back,
        }
        values |= self._cuts.values()
        values |= self._plan.values() if self._plan else {}
        values['diverged_frames'] = self._diverged
        stranger = next(filter(None, (tool.cause for tool in self._tools)), '')
        values['stranger'] = stranger
        if frame is None:
            return DiagnosticStatus.OK, 'starting', values
        values |= {'substeps': frame.substeps, 'slow_motion': frame.slow_motion}
        if (strain := frame.strain) is not None:
            values |= {
                'law_domains': strain.domains,
                'law_elements': strain.elements,
                'least_volume_ratio': strain.ratio[0],
                'largest_volume_ratio': strain.ratio[1],
                'least_stretch': strain.stretch[0],
                'largest_stretch': strain.stretch[1],
                'heavier_nodes': strain.heavier,
                'added_mass': strain.added,
            }
        if frame.diverged:
            return DiagnosticStatus.ERROR, f'a frame was taken back: {frame.trouble}', values
        if frame.trouble:
            return DiagnosticStatus.WARN, frame.trouble, values
        if stranger:
            return DiagnosticStatus.WARN, stranger, values
        if strain is not None and strain.beyond:
            return DiagnosticStatus.WARN, strain.beyond, values
        if self._plan and self._plan.over:
            return DiagnosticStatus.WARN, self._plan.over, values
        if frame.slow_motion < 0.999:
            return DiagnosticStatus.WARN, 'max_substeps is too small for real time', values
        if self._plan and self._plan.unmet:
            return DiagnosticStatus.WARN, self._plan.unmet, values
        if frame.concession:
            said = f'frames come late: {_moving(frame.concession)}'
            return DiagnosticStatus.WARN, said, values
        said = frame.state.name.lower() if frame.state else 'no contact'
        return DiagnosticStatus.OK, said, values


def _moving(concession: int) -> str:
    """Return the part of a sentence on the nodes that a concession leaves free."""
    return f'{round(100 * SHARES[concession])} % of the chosen nodes move on their own'


def main() -> None:
    """Run the node."""
    run(TissueSimNode)


if __name__ == '__main__':
    main()
