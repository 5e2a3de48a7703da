"""Topological cases A to H of a cut tetrahedron, expanded to arrays (thesis 5.3; docs/cutting.md).

A child's corner is a label: 0 to 3 a node of the parent; 4 + 2 e + s the copy of the point on edge
e that stays with the edge's first (s = 0) or second (s = 1) node; 16 + k the point in the face
opposite node k; 20 the inner point.
"""

from itertools import permutations

import numpy as np

from cutting_trainer.cutting.geometry import EDGE_NODES
from cutting_trainer.tissue_sim.mesh.topology import FACE_NODES

MAX_CHILDREN = 16
MID, FRONT, INSIDE = 4, 16, 20
UNKNOWN = -1

# name: (pairs (i, j) that need id[i] < id[j], nodes on the cut, tetrahedra). `ab+` stays with a,
# `ab-` with b.
TABLES: dict[str, tuple[tuple[tuple[int, int], ...], tuple[int, ...], str]] = {
    'A': (
        ((1, 2), (2, 3)),
        (),
        '0 01+ 02+ 03+; 1 01- 03- 02-; 1 2 02- 03-; 1 2 03- 3',
    ),
    'B': (
        ((0, 1), (2, 3)),
        (),
        '0 02+ 03+ 12+; 0 03+ 13+ 12+; 0 1 12+ 13+; 2 02- 12- 03-; 2 03- 12- 13-; 2 3 03- 13-',
    ),
    'C': (
        ((2, 3),),
        (),
        '0 01+ c3 c2; 1 01- c2 c3; 0 2 c2 c3; 1 2 c3 c2; 0 2 3 c2; 1 2 c2 3',
    ),
    'D': (
        ((1, 2),),
        (),
        '0 01+ 02+ c1; 0 01+ c1 c2; 0 3 c2 c1; 1 01- c1 02-; 1 01- c2 c1; 1 2 02- c1; 1 2 c1 3; '
        '1 3 c1 c2',
    ),
    'E12': (
        ((1, 0), (2, 3)),
        (),
        '0 02+ 03+ c3; 0 1 c3 03+; 1 03+ 13+ c0; 1 03+ c0 c3; 1 2 c3 c0; 2 02- c3 03-; '
        '2 03- c3 c0; 2 3 03- c0; 3 03- c0 13-',
    ),
    'E02': (
        ((0, 1), (2, 3)),
        (),
        '0 02+ 03+ c3; 0 03+ 13+ c3; 0 1 c3 13+; 1 13+ c0 c3; 1 2 c3 c0; 2 3 c3 c0; '
        '2 02- c3 03-; 2 3 03- c3; 3 03- c3 13-; 3 13- c3 c0',
    ),
    'E03': (
        ((0, 1), (3, 2)),
        (),
        '0 02+ 03+ c3; 0 03+ 13+ c3; 0 1 c3 13+; 1 13+ c0 c3; 1 2 c3 c0; 2 3 c3 c0; '
        '2 3 02- c3; 3 02- c3 03-; 3 03- c3 13-; 3 13- c3 c0',
    ),
    'F': (((2, 3),), (0,), '0 1 12+ 13+; 0 2 13- 12-; 0 2 3 13-'),
    'G': ((), (0, 1), '0 1 2 23+; 0 1 23- 3'),
    'H': ((), (0,), '0 1 12+ c0; 0 2 c0 12-; 0 1 c0 3; 0 2 3 c0'),
}
"""Cases A to H of the thesis; E by the diagonals of its two faces with two cut edges. Positively
oriented."""
COMPLETE = 'ABFG'
"""Cases that cut their element in two; no crossing can be added to them."""

_EDGES = [tuple(int(i) for i in edge) for edge in EDGE_NODES]
_ORDERS = list(permutations(range(4)))


def _edge(a: int, b: int) -> int:
    return _EDGES.index((min(a, b), max(a, b)))


def _parse(word: str) -> tuple[int, ...]:
    """Return a label as nodes: (a,), (a, b, node it stays with), or (-1, opposite node)."""
    if word[0] == 'c':
        return (-1, int(word[1]))
    if len(word) == 1:
        return (int(word),)
    a, b = int(word[0]), int(word[1])
    return (a, b, a if word[2] == '+' else b)


def _code(label: tuple[int, ...], to: tuple[int, ...]) -> int:
    """Return the label code after renaming canonical node i to `to[i]`."""
    if len(label) == 1:
        return to[label[0]]
    if len(label) == 2:
        return FRONT + to[label[1]]
    edge = _edge(to[label[0]], to[label[1]])
    return MID + 2 * edge + _EDGES[edge].index(to[label[2]])


def _odd(order: tuple[int, ...]) -> bool:
    return sum(order[i] > order[j] for i in range(4) for j in range(i + 1, 4)) % 2 == 1


def _renamed(table: list[list[tuple[int, ...]]], to: tuple[int, ...]) -> list[list[int]]:
    children = [[_code(label, to) for label in tet] for tet in table]
    if _odd(to):
        children = [[a, b, d, c] for a, b, c, d in children]
    return children


def _star(edges: list[int]) -> list[list[int]]:
    """Return a cone from an inner point over faces with one cut edge each, slit to their centre."""
    children = []
    for k in range(4):
        face = [int(i) for i in FACE_NODES[k]]
        (edge,) = (e for e in edges if set(_EDGES[e]) <= set(face))
        first = face.index(next(i for i in face if i not in _EDGES[edge]))
        o, a, b = face[first], face[(first + 1) % 3], face[(first + 2) % 3]
        at_a = MID + 2 * edge + _EDGES[edge].index(a)
        at_b = MID + 2 * edge + _EDGES[edge].index(b)
        c = FRONT + k
        # Outward counter-clockwise seen from outside, hence this order with the inner point last
        # but one.
        children += [[x, y, INSIDE, c] for x, y in ((o, a), (a, at_a), (at_b, b), (b, o))]
    return children


class _Expansion:
    """Builds the arrays below."""

    def __init__(self) -> None:
        self.state = np.full((64, 16), UNKNOWN, np.int16)
        self.names: list[str] = []
        self.children: list[dict[int, list[list[int]]]] = []

    def add(self, name: str, edges: int, nodes: int, order: int, children: list[list[int]]) -> None:
        if self.state[edges, nodes] == UNKNOWN:
            self.state[edges, nodes] = len(self.names)
            self.names.append(name)
            self.children.append({})
        self.children[self.state[edges, nodes]].setdefault(order, children)

    def run(self) -> None:
        for name, (smaller, nodes, text) in TABLES.items():
            table = [[_parse(word) for word in tet.split()] for tet in text.split(';')]
            cut = {label[:2] for tet in table for label in tet if len(label) == 3}
            for to in _ORDERS:
                edges = sum(1 << _edge(to[a], to[b]) for a, b in cut)
                on_cut = sum(1 << to[i] for i in nodes)
                children = _renamed(table, to)
                for k, rank in enumerate(_ORDERS):
                    if all(rank[to[i]] < rank[to[j]] for i, j in smaller):
                        self.add(name[0], edges, on_cut, k, children)
        for first, second in ((0, 5), (1, 4), (2, 3)):
            for k in range(24):
                self.add('star', 1 << first | 1 << second, 0, k, _star([first, second]))

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        shape = (len(self.names), 24)
        children = np.full((*shape, MAX_CHILDREN, 4), -1, np.int8)
        number = np.zeros(shape, np.int8)
        for s, by_order in enumerate(self.children):
            for k, tets in by_order.items():
                children[s, k, : len(tets)] = tets
                number[s, k] = len(tets)
        return children, number


_expansion = _Expansion()
_expansion.run()

STATE = _expansion.state
"""State by bits of the cut edges and bits of the nodes on the cut, UNKNOWN without one, shape (64,
16)."""
NAMES = tuple(_expansion.names)
"""Case of each state: A to H or star."""
CHILDREN, NUMBER = _expansion.arrays()
"""Labels of the children by state and order of the node ids, shape (s, 24, 16, 4), and their
number, shape (s, 24)."""
ORDER = np.full((4, 4, 4, 4), -1, np.int8)
"""Order of the four node ids, by their ranks."""
for _k, _rank in enumerate(_ORDERS):
    ORDER[_rank] = _k
IS_COMPLETE = np.array([name in COMPLETE for name in NAMES])
"""Whether a state cuts its element in two, shape (s,)."""


def _label_faces() -> np.ndarray:
    """Return the faces of each label, shape (21,); bit k: it lies in the face opposite node k."""
    bits = np.zeros(INSIDE + 1, np.uint8)
    for node in range(4):
        bits[node] = 15 & ~(1 << node)
    for edge, (a, b) in enumerate(_EDGES):
        bits[MID + 2 * edge : MID + 2 * edge + 2] = 15 & ~(1 << a) & ~(1 << b)
    for k in range(4):
        bits[FRONT + k] = 1 << k
    return bits


LABEL_FACES = _label_faces()
