"""Pieces that cuts have taken off: their parts, volumes and places."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.tissue_sim.mesh.checks import EDGES, components
from cutting_trainer.tissue_sim.mesh.tetra_mesh import tetrahedron_volumes

Floats = NDArray[np.float64]


class Tissue(Protocol):
    """Mesh of a simulation or of a recording."""

    @property
    def rest(self) -> Floats:
        """Positions at rest [m], shape (n, 3)."""

    @property
    def tetrahedra(self) -> NDArray[Any]:
        """Corners, shape (m, 4)."""

    @property
    def fixed(self) -> NDArray[np.uint8]:
        """1 where a node does not move, shape (n,)."""


@dataclass(frozen=True)
class Piece:
    """A part of the tissue that nothing connects with a fixed node.

    Attributes:
        number: from 1, in the order in which the pieces came off.
        tetrahedra: number of its elements.
        volume: at rest [m^3].
        position: centre of its volume at present [m], shape (3,).
    """

    number: int
    tetrahedra: int
    volume: float
    position: Floats


class PieceRegister:
    """Numbers the pieces of a tissue, each when it comes off.

    A piece that is cut in two keeps its number on the part with the most of its nodes; the other
    part is new.

    Args:
        tissue: pieces in it at the beginning are known already.
    """

    def __init__(self, tissue: Tissue) -> None:
        self._label = np.zeros(0, np.int64)
        self._count = 0
        self.find_new(tissue, tissue.rest)

    def find_new(self, tissue: Tissue, positions: Floats) -> list[Piece]:
        """Return the pieces that came off since the last call.

        Args:
            tissue: now; nodes keep their indices, new ones follow; a cut may take the last back.
            positions: of its nodes [m], shape (n, 3).
        """
        known = np.zeros(len(tissue.rest), np.int64)
        both = min(len(known), len(self._label))
        known[:both] = self._label[:both]
        part = free_parts(tissue)
        self._label = np.zeros_like(known)
        new: list[int] = []
        kept = _kept_numbers(part, known)
        for p in range(1, int(part.max(initial=0)) + 1):
            number = kept.get(p, 0)
            if not number:
                self._count += 1
                number = self._count
                new.append(number)
            self._label[part == p] = number
        return [_piece(number, self._label, tissue, positions) for number in new]

    def nodes_of(self, number: int) -> NDArray[np.int64]:
        """Return the nodes of a piece at the last call of `find_new`, shape (p,)."""
        return np.flatnonzero(self._label == number)


def pieces_of(tissue: Tissue, positions: Floats) -> list[Piece]:
    """Return all pieces, numbered by their first nodes.

    Args:
        tissue: their mesh.
        positions: of its nodes [m], shape (n, 3).
    """
    part = free_parts(tissue)
    return [_piece(p, part, tissue, positions) for p in range(1, int(part.max(initial=0)) + 1)]


def free_parts(tissue: Tissue) -> NDArray[np.int64]:
    """Return the part of each node, from 1; 0 where a path leads to a fixed node, shape (n,).

    Parts are in the order of their first nodes. A node without tetrahedra belongs to none.
    """
    links = np.asarray(tissue.tetrahedra)[:, EDGES].reshape(-1, 2)
    count, part = components(len(tissue.rest), links)
    free = np.zeros(count, bool)
    free[part[links[:, 0]]] = True
    free[part[np.asarray(tissue.fixed) == 1]] = False
    return np.where(free, np.cumsum(free), 0)[part]


def _kept_numbers(part: NDArray[np.int64], known: NDArray[np.int64]) -> dict[int, int]:
    """Return the number that a part keeps, by part: of each number, the part with most nodes."""
    both = (part > 0) & (known > 0)
    pairs, counts = np.unique(np.stack([known[both], part[both]]), axis=1, return_counts=True)
    best: dict[int, tuple[int, int]] = {}
    for number, p, count in zip(*pairs.tolist(), counts.tolist(), strict=True):
        best[number] = max(best.get(number, (0, 0)), (count, -p))
    return {-p: number for number, (_, p) in best.items()}


def _piece(number: int, label: NDArray[np.int64], tissue: Tissue, positions: Floats) -> Piece:
    tetrahedra = np.asarray(tissue.tetrahedra)
    own = tetrahedra[label[tetrahedra[:, 0]] == number]
    volume = tetrahedron_volumes(np.asarray(tissue.rest), own)
    centre = np.asarray(positions)[own].mean(axis=1)
    return Piece(number, len(own), float(volume.sum()), np.average(centre, axis=0, weights=volume))
