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
    def topology(self) -> int:
        """Counts changes of connectivity."""

    @property
    def revision(self) -> int:
        """Counts changes of any kind."""


class DrawnTissue:
    """What a page draws of a replica: faces when they change, positions in every frame.

    Attributes:
        parts: by kind, as of the last `follow`.
    """

    def __init__(self) -> None:
        self.parts: dict[int, Part] = {}
        self._known: tuple[object, int] = (None, -1)

    def follow(self, replica: Surface) -> bool:
        """Takes the replica's connectivity; whether the faces are others than before."""
        triangles, kinds = replica.triangles, replica.triangle_kind
        base = triangles if triangles.base is None else triangles.base
        if self.parts and self._known[0] is base and self._known[1] == replica.topology:
            return False
        self._known = base, replica.topology
        self.parts = {kind: part(triangles, kinds, kind) for kind in (OUTER, CUT)}
        return True

    def positions(self, replica: Surface, kind: int) -> NDArray[np.float32]:
        """Of a part's nodes now [m], shape (n, 3)."""
        nodes = self.parts[kind].nodes
        return (replica.rest[nodes] + replica.displacement[nodes]).astype(np.float32)
