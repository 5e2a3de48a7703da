"""Conversion between the simulation's data and `cutting_trainer_msgs`; arrays are sent as
stored.
"""

import array
from typing import Any

import numpy as np
from cutting_trainer_msgs.msg import (
    Contact,
    ForceSample,
    FrameInputs,
    FreePiece,
    Mesh,
    MeshDelta,
)
from cutting_trainer_msgs.srv import Cut

from cutting_trainer.node_common.ros import FRAME, stamp
from cutting_trainer.node_common.stamps import REVISION_MODULUS
from cutting_trainer.tissue_sim.contact.tool import Frame
from cutting_trainer.tissue_sim.mesh.pieces import Piece
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica, state_hash
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta, Touched
from cutting_trainer.tissue_sim.simulation.cut_transaction import ANSWER_FRAMES, Resolved

_MAX_HASHED_TETRAHEDRA = 25_000
"""Size up to which a change of connectivity carries a hash of the whole tissue. The cost of a hash
follows the tissue, not the cut; of a larger one only keyframes carry it."""
_CODES = {'d': np.float64, 'I': np.uint32, 'B': np.uint8}


def packed(code: str, values: np.ndarray) -> 'array.array[Any]':
    """Return values as the array type of message fields: d, I or B."""
    out: array.array[Any] = array.array(code)
    out.frombytes(np.ascontiguousarray(values, _CODES[code]).tobytes())
    return out


def mesh_message(
    mesh: TetMesh | MeshReplica,
    displacement: np.ndarray,
    scene: str,
    revision: int,
    step: int,
    time_ns: int,
) -> Mesh:
    """Return the whole tissue as a message."""
    message = Mesh(scene=scene, revision=revision, topology=mesh.topology, step=step)
    message.header.frame_id = FRAME
    message.header.stamp = stamp(time_ns)
    message.rest = packed('d', mesh.rest)
    message.displacement = packed('d', displacement)
    message.fixed = packed('B', mesh.fixed)
    message.tetrahedra = packed('I', mesh.tetrahedra)
    message.triangles = packed('I', mesh.triangles)
    message.triangle_kind = packed('B', mesh.triangle_kind)
    message.region = packed('B', mesh.regions)
    message.state_hash = state_hash(mesh.rest, displacement, mesh.tetrahedra)
    return message


class DeltaEncoder:
    """Encoder of the deltas between published states.

    Args:
        mesh: the tissue.
        displacement: [m], shape (n, 3), as in the full mesh published before.
    """

    def __init__(self, mesh: TetMesh, displacement: np.ndarray) -> None:
        self._mesh = mesh
        self._sent = displacement.copy()
        self.revision = 0

    def encode(
        self,
        displacement: np.ndarray,
        step: int,
        time_ns: int,
        touched: Touched | None,
        cut_step: int,
    ) -> MeshDelta | None:
        """Return the delta to the present state, or None without a difference.

        Args:
            displacement: present [m], shape (n, 3).
            step: simulation frame.
            time_ns: stamp [ns].
            touched: slots written by the last change of connectivity, if it came since the last
                delta.
            cut_step: frame from whose shape that change was computed.
        """
        mesh, n = self._mesh, self._mesh.node_count
        if touched is None:
            differs = displacement != self._sent
            displaced = np.flatnonzero(differs[:, 0] | differs[:, 1] | differs[:, 2])
            if len(displaced) == 0:
                return None
        else:
            displaced = np.arange(n)
        message = MeshDelta(base_revision=self.revision, step=step, topology=mesh.topology)
        self.revision = (self.revision + 1) % REVISION_MODULUS
        message.revision = self.revision
        message.header.frame_id = FRAME
        message.header.stamp = stamp(time_ns)
        message.node_count = n
        message.tetrahedron_count = len(mesh.tetrahedra)
        message.triangle_count = len(mesh.triangles)
        if len(displaced) < n:
            message.displaced = packed('I', displaced)
        message.displacement = packed('d', displacement[displaced])
        if touched is not None:
            self._connectivity(message, touched)
            message.cut_step = cut_step
            if message.tetrahedron_count <= _MAX_HASHED_TETRAHEDRA:
                message.state_hash = state_hash(mesh.rest, displacement, mesh.tetrahedra)
        self._sent = displacement.copy()
        return message

    def _connectivity(self, message: MeshDelta, touched: Touched) -> None:
        mesh = self._mesh
        message.rest_changed = packed('I', touched.rest)
        message.rest = packed('d', mesh.rest[touched.rest])
        message.fixed = packed('B', mesh.fixed[touched.rest])
        message.tetrahedra_changed = packed('I', touched.tetrahedra)
        message.tetrahedra = packed('I', mesh.tetrahedra[touched.tetrahedra])
        message.region = packed('B', mesh.regions_at(touched.tetrahedra))
        message.triangles_changed = packed('I', touched.triangles)
        message.triangles = packed('I', mesh.triangles[touched.triangles])
        message.triangle_kind = packed('B', mesh.triangle_kind[touched.triangles])


def force_message(
    frame: Frame, revision: int, topology: int, contact: Contact | None, time_ns: int
) -> ForceSample:
    """Return the reaction of one frame as a message."""
    message = ForceSample(step=frame.step, revision=revision, topology=topology, tool=frame.tool)
    message.header.frame_id = FRAME
    message.header.stamp = stamp(time_ns)
    if contact is not None:
        message.contact_sequence = contact.sequence
        message.contact_stamp = contact.header.stamp
    message.state = int(frame.state)
    message.position = frame.position
    message.force = frame.force
    message.stiffness = frame.stiffness.ravel()
    message.resistance = frame.resistance
    message.kinetic_energy = frame.kinetic_energy
    message.elastic_energy = frame.elastic_energy
    message.torque = frame.turning.torque
    message.torque_resistance = frame.turning.resistance
    message.immersed = frame.turning.immersed
    return message


def inputs_message(
    frame: Frame, contact: Contact | None, resolved: Resolved, time_ns: int
) -> FrameInputs:
    """Return the inputs of a frame as a message.

    Args:
        frame: its result.
        contact: its contact, or None.
        resolved: the cut applied at its beginning.
        time_ns: stamp [ns].
    """
    message = FrameInputs(step=frame.step, diverged=frame.diverged, tool=frame.tool)
    message.concession = frame.concession
    message.answer, message.cut_step = int(resolved.outcome), resolved.cut_step
    message.answer_frames, message.waited = ANSWER_FRAMES, resolved.waited
    message.header.frame_id = FRAME
    message.header.stamp = stamp(time_ns)
    if contact is not None:
        message.has_contact = True
        message.contact_sequence = contact.sequence
        message.contact_stamp = contact.header.stamp
    return message


def piece_message(piece: Piece, mass: float, step: int, topology: int, time_ns: int) -> FreePiece:
    """Return a piece that came off as a message.

    Args:
        piece: the piece.
        mass: [kg].
        step: frame in which it was found.
        topology: connectivity count of the mesh.
        time_ns: stamp [ns].
    """
    message = FreePiece(step=step, topology=topology, number=piece.number, mass=mass)
    message.header.frame_id = FRAME
    message.header.stamp = stamp(time_ns)
    message.tetrahedra = piece.tetrahedra
    message.volume = piece.volume
    message.position = piece.position
    return message


def delta_into(message: Any, delta: TopologyDelta) -> None:
    """Write a change of connectivity into a `Cut` response."""
    message.node_parents = packed('I', delta.node_parents)
    message.node_weights = packed('d', delta.node_weights)
    message.moved_nodes = packed('I', delta.moved_nodes)
    message.moved_parents = packed('I', delta.moved_parents)
    message.moved_weights = packed('d', delta.moved_weights)
    message.removed_tetrahedra = packed('I', delta.removed_tetrahedra)
    message.tetrahedra = packed('I', delta.tetrahedra)
    message.outer_faces = packed('B', delta.outer_faces)
    message.regions = packed('B', delta.regions)


def delta_from(message: Cut.Response) -> TopologyDelta:
    """Read a change of connectivity from a `Cut` response.

    Raises:
        ValueError: its arrays do not fit each other.
    """

    def array_of(name: str, dtype: type, width: int) -> np.ndarray:
        flat: np.ndarray = np.array(getattr(message, name), dtype)
        if len(flat) % width:
            raise ValueError(f'{name} has {len(flat)} values, not a multiple of {width}')
        return flat.reshape(-1, width) if width > 1 else flat

    delta = TopologyDelta(
        node_parents=array_of('node_parents', np.int64, 4),
        node_weights=array_of('node_weights', np.float64, 4),
        moved_nodes=array_of('moved_nodes', np.int64, 1),
        moved_parents=array_of('moved_parents', np.int64, 4),
        moved_weights=array_of('moved_weights', np.float64, 4),
        removed_tetrahedra=array_of('removed_tetrahedra', np.int64, 1),
        tetrahedra=array_of('tetrahedra', np.int64, 4),
        outer_faces=array_of('outer_faces', np.uint8, 1),
        regions=array_of('regions', np.uint8, 1),
    )
    pairs = (
        ('node_weights', delta.node_weights, delta.node_parents),
        ('moved_parents', delta.moved_parents, delta.moved_nodes),
        ('moved_weights', delta.moved_weights, delta.moved_nodes),
        ('outer_faces', delta.outer_faces, delta.tetrahedra),
    )
    for name, values, rows in pairs:
        if len(values) != len(rows):
            raise ValueError(f'{name} has {len(values)} rows where {len(rows)} belong')
    if not (np.isfinite(delta.node_weights).all() and np.isfinite(delta.moved_weights).all()):
        raise ValueError('a weight is not finite')
    return delta
