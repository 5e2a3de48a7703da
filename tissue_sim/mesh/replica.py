"""Replica of the tissue that follows the published revisions, for nodes that do not own it."""

import hashlib
from typing import Any

import numpy as np

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.node_common.rejections import MessageError
from cutting_trainer.node_common.stamps import newer
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, grown


def state_hash(rest: np.ndarray, displacement: np.ndarray, tetrahedra: np.ndarray) -> int:
    """Return the first 8 bytes, little endian, of BLAKE2b over rest, displacement and tetrahedra.

    Args:
        rest, displacement: [m], float64, shape (n, 3).
        tetrahedra: node indices, shape (m, 4).
    """
    digest = hashlib.blake2b(digest_size=8)
    digest.update(np.ascontiguousarray(rest, np.float64).data)
    digest.update(np.ascontiguousarray(displacement, np.float64).data)
    digest.update(np.ascontiguousarray(tetrahedra, np.uint32).data)
    return int.from_bytes(digest.digest(), 'little')


MAX_NODES = 2_000_000
"""Size of an accepted mesh, unless the node's parameter `max_nodes` sets another."""


BYTES_PER_NODE = 512
"""Size of a mesh message with the largest accepted number of tetrahedra and triangles, per node."""
MAX_COORDINATE = 1e3
"""[m] of a node in the tissue frame."""


class MeshReplica:
    """Arrays rebuilt from `Mesh` and `MeshDelta` messages, or anything with the same fields.

    Args:
        max_nodes: size of an accepted mesh; eight times as many tetrahedra and triangles.

    Attributes:
        revision, topology, step: of the last message; revision is -1 before the first.
    """

    def __init__(self, max_nodes: int = MAX_NODES) -> None:
        self._most = {'nodes': max_nodes, 'tetrahedra': 8 * max_nodes, 'triangles': 8 * max_nodes}
        self.revision = -1
        self.topology = -1
        self.step = 0
        self._nodes = self._tets = self._tris = 0
        self._rest = np.zeros((0, 3))
        self._displacement = np.zeros((0, 3))
        self._fixed = np.zeros(0, np.uint8)
        self._tetrahedra = np.zeros((0, 4), np.int32)
        self._triangles = np.zeros((0, 3), np.int32)
        self._kind = np.zeros(0, np.uint8)
        self._region = np.zeros(0, np.uint8)

    @property
    def rest(self) -> np.ndarray:
        """Rest positions [m], shape (n, 3); a view."""
        return self._rest[: self._nodes]

    @property
    def displacement(self) -> np.ndarray:
        """Displacements [m], shape (n, 3); a view."""
        return self._displacement[: self._nodes]

    @property
    def fixed(self) -> np.ndarray:
        """1 where the node does not move, shape (n,); a view."""
        return self._fixed[: self._nodes]

    @property
    def tetrahedra(self) -> np.ndarray:
        """Node indices, shape (m, 4); a view."""
        return self._tetrahedra[: self._tets]

    @property
    def triangles(self) -> np.ndarray:
        """Surface triangles, outward counter-clockwise, shape (k, 3); a view."""
        return self._triangles[: self._tris]

    @property
    def triangle_kind(self) -> np.ndarray:
        """OUTER or CUT by surface triangle, shape (k,); a view."""
        return self._kind[: self._tris]

    @property
    def regions(self) -> np.ndarray:
        """Row of the table of materials by tetrahedron, shape (m,), (0,) with one; a view."""
        return self._region[: self._tets]

    def positions(self) -> np.ndarray:
        """Return current positions [m], shape (n, 3); a new array."""
        return self.rest + self.displacement

    def mesh(self) -> TetMesh:
        """Return a new mesh with the same nodes, tetrahedra and surface.

        Raises:
            MeshError: the received arrays are no valid mesh.
        """
        mesh = TetMesh(self.rest, self.tetrahedra, self.fixed, self.regions)
        if len(mesh.triangles) != self._tris:
            text = f'{self._tris} surface triangles were sent, the tetrahedra have'
            raise MeshError(f'{text} {len(mesh.triangles)}')
        mesh.topology = self.topology
        mesh.set_kinds(self.triangles, self.triangle_kind)
        return mesh

    def hash(self) -> int:
        """Return the `state_hash` of the replica."""
        return state_hash(self.rest, self.displacement, self.tetrahedra)

    def load(self, mesh: Any) -> None:
        """Load a full mesh.

        Args:
            mesh: a `Mesh` message.

        Raises:
            MessageError: its arrays do not fit each other or its hash, or a number is out of range.
        """
        n, remainder = divmod(len(mesh.rest), 3)
        self._require_size(n, len(mesh.tetrahedra) // 4, len(mesh.triangles) // 3)
        tets = _indices(mesh.tetrahedra, 4, n, 'tetrahedra')
        tris = _indices(mesh.triangles, 3, n, 'triangles')
        region = np.array(getattr(mesh, 'region', ()), np.uint8)  # an old bag has none
        lengths = (
            ('rest', remainder, 0),
            ('displacement', len(mesh.displacement), 3 * n),
            ('fixed', len(mesh.fixed), n),
            ('triangle_kind', len(mesh.triangle_kind), len(tris)),
            ('region', len(region), len(tets) if len(region) else 0),
        )
        for name, have, want in lengths:
            if have != want:
                text = f'mesh field {name} has a length that does not fit {n} nodes'
                raise MessageError('arrays that do not fit', text)
        rest, moved = _positions(mesh.rest, 'rest'), _positions(mesh.displacement, 'displacement')
        given = getattr(mesh, 'state_hash', 0)
        if given and given != state_hash(rest, moved, tets):
            raise MessageError('wrong hash', f'mesh of revision {mesh.revision}')
        self._nodes, self._tets, self._tris = n, len(tets), len(tris)
        self._rest, self._displacement = rest, moved
        self._fixed = np.array(mesh.fixed, np.uint8)
        self._tetrahedra, self._triangles = tets, tris
        self._kind = np.array(mesh.triangle_kind, np.uint8)
        self._region = region
        self.revision, self.topology, self.step = mesh.revision, mesh.topology, mesh.step

    def apply(self, delta: Any) -> bool:
        """Apply a delta.

        Args:
            delta: a `MeshDelta` message.

        Returns:
            False if it starts from another revision: then nothing is changed, and the full mesh is
            needed. A delta already contained in this revision is skipped with True.

        Raises:
            MessageError: its arrays do not fit each other, or a number is out of range; nothing is
                changed.
        """
        if not newer(delta.revision, self.revision):
            return True
        if delta.base_revision != self.revision:
            return False
        n, m, k = delta.node_count, delta.tetrahedron_count, delta.triangle_count
        self._require_size(n, m, k)
        everything = len(delta.displaced) == 0 and len(delta.displacement) > 0
        rest_at = _slots(delta.rest_changed, n, 'rest_changed')
        tets_at = _slots(delta.tetrahedra_changed, m, 'tetrahedra_changed')
        tris_at = _slots(delta.triangles_changed, k, 'triangles_changed')
        self._require_growth(n, rest_at, m, tets_at, k, tris_at)
        moved_at = np.arange(n) if everything else _slots(delta.displaced, n, 'displaced')
        tets = _indices(delta.tetrahedra, 4, n, 'tetrahedra')
        tris = _indices(delta.triangles, 3, n, 'triangles')
        region = np.array(getattr(delta, 'region', ()), np.uint8)
        lengths = (
            ('displacement', len(delta.displacement), 3 * len(moved_at)),
            ('rest', len(delta.rest), 3 * len(rest_at)),
            ('fixed', len(delta.fixed), len(rest_at)),
            ('tetrahedra', len(tets), len(tets_at)),
            ('triangles', len(tris), len(tris_at)),
            ('triangle_kind', len(delta.triangle_kind), len(tris_at)),
            ('region', len(region), len(tets_at) if len(self._region) else 0),
        )
        for name, have, want in lengths:
            if have != want:
                text = f'mesh delta field {name} has {have} values where {want} belong'
                raise MessageError('arrays that do not fit', text)
        rest, moved = _positions(delta.rest, 'rest'), _positions(delta.displacement, 'displacement')
        self._resize(n, m, k)
        self._rest[rest_at] = rest
        self._fixed[rest_at] = np.array(delta.fixed, np.uint8)
        self._tetrahedra[tets_at] = tets
        if len(self._region):
            self._region[tets_at] = region
        self._triangles[tris_at] = tris
        self._kind[tris_at] = np.array(delta.triangle_kind, np.uint8)
        self._displacement[moved_at] = moved
        self.revision, self.topology, self.step = delta.revision, delta.topology, delta.step
        return True

    def _require_size(self, *counts: int) -> None:
        for (name, most), count in zip(self._most.items(), counts, strict=True):
            if count > most:
                text = f'mesh of {count} {name}: this node accepts {most} (parameter max_nodes)'
                raise MessageError('too large', text)

    def _require_growth(
        self, n: int, nodes: np.ndarray, m: int, tets: np.ndarray, k: int, triangles: np.ndarray
    ) -> None:
        """Refuse counts larger than the known ones plus the delta's slots."""
        for name, count, known, given in (
            ('node', n, self._nodes, nodes),
            ('tetrahedron', m, self._tets, tets),
            ('triangle', k, self._tris, triangles),
        ):
            if count > known + len(given):
                text = (
                    f'mesh delta field {name}_count is {count}, but there are {known} and the '
                    f'delta gives {len(given)} slots'
                )
                raise MessageError('counts beyond its arrays', text)

    def _resize(self, n: int, m: int, k: int) -> None:
        self._rest = grown(self._rest, n)
        self._displacement = grown(self._displacement, n)
        self._fixed = grown(self._fixed, n)
        self._tetrahedra = grown(self._tetrahedra, m)
        self._triangles = grown(self._triangles, k)
        self._kind = grown(self._kind, k)
        self._region = grown(self._region, m) if len(self._region) else self._region
        self._nodes, self._tets, self._tris = n, m, k


def _positions(values: Any, name: str) -> np.ndarray:
    out: np.ndarray = np.array(values, float).reshape(-1, 3)
    if not (np.abs(out) <= MAX_COORDINATE).all():  # a NaN is not
        text = f'mesh field {name} has a number that is not finite or beyond {MAX_COORDINATE:g} m'
        raise MessageError('not finite or too far', text)
    return out


def _slots(values: Any, limit: int, name: str) -> np.ndarray:
    slots = np.array(values, np.int64)
    if len(slots) and slots.max() >= limit:
        text = f'mesh delta field {name} has slot {slots.max()} of {limit}'
        raise MessageError('index out of range', text)
    return slots


def _indices(values: Any, width: int, nodes: int, name: str) -> np.ndarray:
    flat = np.array(values, np.int64)
    if len(flat) % width:
        text = f'mesh field {name} has {len(flat)} values, not a multiple of {width}'
        raise MessageError('arrays that do not fit', text)
    if len(flat) and flat.max() >= nodes:
        raise MessageError(
            'index out of range', f'mesh field {name} has node {flat.max()} of {nodes}'
        )
    return flat.astype(np.int32).reshape(-1, width)
