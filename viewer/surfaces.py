"""The tissue's surface as the parts that are drawn: the organ's outside, and what cuts opened."""

from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

OUTER, CUT = 0, 1
"""Kinds of triangles, as in `Mesh`."""


class Part(NamedTuple):
    """The triangles of one kind, with the nodes that they need and no others.

    Attributes:
        nodes: of the tissue, ascending, shape (n,).
        faces: indices into `nodes`, shape (k, 3), uint32.
    """

    nodes: NDArray[np.int64]
    faces: NDArray[np.uint32]


def part(triangles: NDArray[np.int32], kinds: NDArray[np.uint8], kind: int) -> Part:
    """The part of one kind.

    Args:
        triangles: node indices, shape (k, 3).
        kinds: by triangle, shape (k,).
        kind: OUTER or CUT.
    """
    nodes, faces = np.unique(triangles[kinds == kind], return_inverse=True)
    return Part(nodes.astype(np.int64), faces.reshape(-1, 3).astype(np.uint32))


class Lips(NamedTuple):
    """Where what a cut has opened meets the outside.

    Attributes:
        edges: nodes of the tissue, shape (n, 2).
        corners: of the outer triangle at each, as the surface has them, shape (n, 3).
    """

    edges: NDArray[np.int64]
    corners: NDArray[np.int64]

    def points(self, positions: NDArray[np.float64], lift: float) -> NDArray[np.float32]:
        """Begin and end of each edge, somewhat above the surface [m], shape (n, 2, 3).

        Args:
            positions: of the tissue's nodes [m], shape (k, 3).
            lift: how far above [m].
        """
        a, b, c = np.moveaxis(positions[self.corners], 1, 0)
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        return (positions[self.edges] + lift * normals[:, None]).astype(np.float32)


def lips(triangles: NDArray[np.int32], kinds: NDArray[np.uint8]) -> Lips:
    """The lips of all cuts.

    Args:
        triangles: node indices, shape (k, 3).
        kinds: by triangle, shape (k,).
    """
    corners = triangles.astype(np.int64)
    edges = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2)
    keys = edges.min(axis=1) * (corners.max(initial=0) + 1) + edges.max(axis=1)
    opened = np.repeat(kinds == CUT, 3)
    chosen = ~opened & np.isin(keys, keys[opened])
    return Lips(edges[chosen], np.repeat(corners, 3, axis=0)[chosen])


class Surface(Protocol):
    """A tissue as far as it is drawn: a `MeshReplica`, or whatever has the same fields."""

    @property
    def rest(self) -> NDArray[np.float64]:
        """[m], shape (n, 3)."""

    @property
    def displacement(self) -> NDArray[Any]:
        """[m], shape (n, 3)."""

    @property
    def triangles(self) -> NDArray[np.int32]:
        """Node indices, shape (k, 3)."""

    @property
    def triangle_kind(self) -> NDArray[np.uint8]:
        """OUTER or CUT, shape (k,)."""

    @property
    def revision(self) -> int:
        """Counts changes of any kind."""


class DrawnTissue:
    """What a page draws of a replica: faces when they change, positions in every frame.

    Attributes:
        parts: by kind, as of the last `follow`.
        lips: of its cuts, the same.
    """

    def __init__(self) -> None:
        self.parts: dict[int, Part] = {}
        self.lips = lips(np.zeros((0, 3), np.int32), np.zeros(0, np.uint8))
        self._known = np.zeros((0, 3), np.int32), np.zeros(0, np.uint8)

    def follow(self, replica: Surface) -> bool:
        """Takes the replica's connectivity; whether the faces are others than before."""
        triangles, kinds = replica.triangles, replica.triangle_kind
        # By what they hold: a whole mesh comes every five seconds, mostly with the same faces.
        known, of_kind = self._known
        if self.parts and np.array_equal(triangles, known) and np.array_equal(kinds, of_kind):
            return False
        self._known = triangles.copy(), kinds.copy()
        self.parts = {kind: part(triangles, kinds, kind) for kind in (OUTER, CUT)}
        self.lips = lips(triangles, kinds)
        return True

    def positions(self, replica: Surface, kind: int) -> NDArray[np.float32]:
        """Of a part's nodes now [m], shape (n, 3)."""
        nodes = self.parts[kind].nodes
        return (replica.rest[nodes] + replica.displacement[nodes]).astype(np.float32)
