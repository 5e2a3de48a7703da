"""Drawn parts of the tissue's surface: the outside, the cut faces, and the edges of the cuts."""

from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.viewer.page_state import TissueFrame

OUTER, CUT = 0, 1
"""Kinds of triangles, as in `Mesh`."""
_LIFT_M = 0.0004
"""[m] Height of the band along the edges of a cut. In a tissue without tension a cut closes again,
and only this band shows it."""


class SurfacePart(NamedTuple):
    """The triangles of one kind, with the nodes that they need and no others.

    Attributes:
        nodes: of the tissue, ascending, shape (n,).
        faces: indices into `nodes`, shape (k, 3), uint32.
    """

    nodes: NDArray[np.int64]
    faces: NDArray[np.uint32]


def part(triangles: NDArray[np.int32], kinds: NDArray[np.uint8], kind: int) -> SurfacePart:
    """Return the part of one kind.

    Args:
        triangles: node indices, shape (k, 3).
        kinds: by triangle, shape (k,).
        kind: OUTER or CUT.
    """
    nodes, faces = np.unique(triangles[kinds == kind], return_inverse=True)
    return SurfacePart(nodes.astype(np.int64), faces.reshape(-1, 3).astype(np.uint32))


class CutEdges(NamedTuple):
    """Edges where cut faces meet the outside.

    Attributes:
        edges: nodes of the tissue, shape (n, 2).
        corners: of the outer triangle at each, in the surface's order, shape (n, 3).
    """

    edges: NDArray[np.int64]
    corners: NDArray[np.int64]

    def points(self, positions: NDArray[np.float64], lift: float) -> NDArray[np.float32]:
        """Return begin and end of each edge, slightly above the surface [m], shape (n, 2, 3).

        Args:
            positions: of the tissue's nodes [m], shape (k, 3).
            lift: height above the surface [m].
        """
        a, b, c = np.moveaxis(positions[self.corners], 1, 0)
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        return (positions[self.edges] + lift * normals[:, None]).astype(np.float32)


def cut_edges(triangles: NDArray[np.int32], kinds: NDArray[np.uint8]) -> CutEdges:
    """Return the edges of all cuts.

    Args:
        triangles: node indices, shape (k, 3).
        kinds: by triangle, shape (k,).
    """
    corners = triangles.astype(np.int64)
    edges = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2)
    keys = edges.min(axis=1) * (corners.max(initial=0) + 1) + edges.max(axis=1)
    opened = np.repeat(kinds == CUT, 3)
    chosen = ~opened & np.isin(keys, keys[opened])
    return CutEdges(edges[chosen], np.repeat(corners, 3, axis=0)[chosen])


class DrawableTissue(Protocol):
    """Drawn fields of a tissue: a `MeshReplica`, or another class with the same fields."""

    @property
    def rest(self) -> NDArray[np.float64]:
        """Return the rest positions [m], shape (n, 3)."""

    @property
    def displacement(self) -> NDArray[Any]:
        """Return the displacements [m], shape (n, 3)."""

    @property
    def triangles(self) -> NDArray[np.int32]:
        """Return the node indices, shape (k, 3)."""

    @property
    def triangle_kind(self) -> NDArray[np.uint8]:
        """Return OUTER or CUT by triangle, shape (k,)."""

    @property
    def revision(self) -> int:
        """Return a number that counts changes of any kind."""


class DrawnTissue:
    """Drawn geometry of a replica: faces when they change, positions in every frame.

    Attributes:
        parts: by kind, as of the last `follow`.
        cut_edges: edges of its cuts, the same.
    """

    def __init__(self) -> None:
        self.parts: dict[int, SurfacePart] = {}
        self.cut_edges = cut_edges(np.zeros((0, 3), np.int32), np.zeros(0, np.uint8))
        self._known = np.zeros((0, 3), np.int32), np.zeros(0, np.uint8)

    def follow(self, replica: DrawableTissue) -> bool:
        """Read the replica's connectivity; return whether the faces have changed."""
        triangles, kinds = replica.triangles, replica.triangle_kind
        # Compared by content: a whole mesh comes every five seconds, mostly with the same faces.
        known, of_kind = self._known
        if self.parts and np.array_equal(triangles, known) and np.array_equal(kinds, of_kind):
            return False
        self._known = triangles.copy(), kinds.copy()
        self.parts = {kind: part(triangles, kinds, kind) for kind in (OUTER, CUT)}
        self.cut_edges = cut_edges(triangles, kinds)
        return True

    def positions(self, replica: DrawableTissue, kind: int) -> NDArray[np.float32]:
        """Return the positions of a part's nodes now [m], shape (n, 3)."""
        nodes = self.parts[kind].nodes
        return (replica.rest[nodes] + replica.displacement[nodes]).astype(np.float32)


class TissueSource:
    """Creates the frames of a tissue for pages.

    Args:
        name: of the tissue on the pages.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._drawn = DrawnTissue()
        self._shown: tuple[object, int] = (None, -1)
        self._array: object = None
        self._frames = self._faces = 0

    def frame(self, replica: DrawableTissue) -> TissueFrame | None:
        """Return the tissue as it is now; None where it has not changed since the last call."""
        now, rest = (replica, replica.revision), replica.rest
        array = rest if rest.base is None else rest.base
        # Another tissue may have the same revision; its arrays are others.
        if (now == self._shown and array is self._array) or replica.revision < 0:
            return None
        self._shown, self._array = now, array
        self._frames += 1
        self._faces += self._drawn.follow(replica)
        parts = self._drawn.parts
        return TissueFrame(
            name=self._name,
            revision=self._frames,
            faces_revision=self._faces,
            positions=tuple(self._drawn.positions(replica, kind) for kind in parts),
            faces=tuple(part.faces for part in parts.values()),
            cut_edges=self._drawn.cut_edges.points(
                replica.rest + replica.displacement, _LIFT_M
            ).reshape(-1, 3),
            rest=replica.rest[parts[OUTER].nodes, :2].astype(np.float32),
        )
