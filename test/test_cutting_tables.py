"""The tables of cases A to H, checked exhaustively in exact integers."""

from collections import Counter
from fractions import Fraction
from itertools import combinations, permutations, product

import numpy as np
import pytest

from cutting_trainer.cutting.geometry import EDGE_NODES
from cutting_trainer.cutting.subdivision_cases import (
    CHILDREN,
    IS_COMPLETE,
    NAMES,
    NUMBER,
    ORDER,
    STATE,
)

EDGES = [tuple(int(i) for i in edge) for edge in EDGE_NODES]
FACES = list(combinations(range(4), 3))
COUNTS = {
    'A': {4},
    'B': {6},
    'C': {6},
    'D': {8},
    'E': {9, 10},
    'F': {3},
    'G': {2},
    'H': {4},
    'star': {16},
}
ORIENTATIONS = {'A': 4, 'B': 3, 'C': 6, 'D': 12, 'E': 12, 'F': 12, 'G': 6, 'H': 12, 'star': 3}


def states():
    """(bits of edges, bits of nodes) of every state that the tables know."""
    return [tuple(int(i) for i in state) for state in np.argwhere(STATE >= 0)]


def place(code):
    """Barycentric coordinates times 12."""
    x = [0, 0, 0, 0]
    if code < 4:
        x[code] = 12
    elif code < 16:
        for node in EDGES[(code - 4) // 2]:
            x[node] = 6
    elif code < 20:
        x = [0 if node == code - 16 else 4 for node in range(4)]
    else:
        x = [3, 3, 3, 3]
    return x


def determinant(rows):
    total = 0
    for order in permutations(range(4)):
        swaps = sum(order[i] > order[j] for i in range(4) for j in range(i + 1, 4))
        term = 1
        for i in range(4):
            term *= rows[i][order[i]]
        total += -term if swaps % 2 else term
    return total


VOLUME = {}


def volume(tet):
    if tet not in VOLUME:
        VOLUME[tet] = determinant([place(code) for code in tet])
    return VOLUME[tet]


def children(edges, nodes, rank):
    state, order = STATE[edges, nodes], ORDER[rank]
    return [tuple(int(i) for i in t) for t in CHILDREN[state, order, : NUMBER[state, order]]]


def mid(a, b, stays):
    edge = EDGES.index((min(a, b), max(a, b)))
    return 4 + 2 * edge + EDGES[edge].index(stays)


def face_triangles(face, edges, nodes, rank):
    """What both neighbours of a face must make of it: decided from the face alone."""
    cut = [e for e in combinations(face, 2) if edges >> EDGES.index(e) & 1]
    opposite = ({0, 1, 2, 3} - set(face)).pop()
    if not cut:
        return [face]
    if len(cut) == 1:
        a, b = cut[0]
        (o,) = set(face) - {a, b}
        if nodes >> o & 1:
            return [(o, a, mid(a, b, a)), (o, b, mid(a, b, b))]
        c = 16 + opposite
        return [(a, mid(a, b, a), c), (b, mid(a, b, b), c), (b, o, c), (o, a, c)]
    (tip,) = set(cut[0]) & set(cut[1])
    low, high = sorted(set(face) - {tip}, key=lambda node: rank[node])
    return [
        (tip, mid(tip, low, tip), mid(tip, high, tip)),
        (low, high, mid(tip, high, high)),
        (low, mid(tip, high, high), mid(tip, low, low)),
    ]


def position(code):
    """A label without its side."""
    return code - code % 2 if 4 <= code < 16 else code


def components(count, links):
    group = list(range(count))
    for a, b in links:
        old, new = group[a], group[b]
        group = [new if g == old else g for g in group]
    return len(set(group))


def faces_of(tets):
    """Indices of the children on each of their faces."""
    faces = {}
    for k, tet in enumerate(tets):
        for face in combinations(sorted(tet), 3):
            faces.setdefault(face, []).append(k)
    return faces


@pytest.fixture(scope='module')
def decompositions():
    return [
        (edges, nodes, rank, children(edges, nodes, rank))
        for edges, nodes in states()
        for rank in permutations(range(4))
    ]


def test_every_case_has_as_many_orientations_and_tetrahedra_as_it_must():
    found = {
        NAMES[STATE[state]]: {len(children(*state, rank)) for rank in permutations(range(4))}
        for state in states()
    }
    assert found == COUNTS
    assert Counter(NAMES) == ORIENTATIONS


def test_every_combination_of_sides_and_reached_points_is_a_known_state():
    for sides in product((-1, 0, 1), repeat=4):
        apart = [k for k, (a, b) in enumerate(EDGES) if sides[a] * sides[b] < 0]
        on_cut = [i for i in range(4) if sides[i] == 0]
        for reached in product((0, 1), repeat=len(apart) + len(on_cut)):
            edges = sum(bit << k for k, bit in zip(apart, reached, strict=False))
            nodes = sum(bit << i for i, bit in zip(on_cut, reached[len(apart) :], strict=True))
            assert not edges or STATE[edges, nodes] >= 0


def test_children_are_positive_and_fill_their_parent_exactly(decompositions):
    for *_, tets in decompositions:
        volumes = [volume(tet) for tet in tets]
        assert min(volumes) > 0
        assert sum(volumes) == 12**4


def test_faces_of_the_parent_are_divided_as_their_neighbour_divides_them(decompositions):
    for edges, nodes, rank, tets in decompositions:
        want = {
            tuple(sorted(triangle))
            for face in FACES
            for triangle in face_triangles(face, edges, nodes, rank)
        }
        have = {
            face
            for face in faces_of(tets)
            if any(all(place(code)[k] == 0 for code in face) for k in range(4))
        }
        assert have == want


def test_inner_faces_are_shared_by_two_or_lie_on_the_cut_in_pairs(decompositions):
    for *_, tets in decompositions:
        on_cut = Counter()
        for face, owners in faces_of(tets).items():
            assert len(owners) <= 2
            outside = any(all(place(code)[k] == 0 for code in face) for k in range(4))
            if len(owners) == 1 and not outside:
                on_cut[tuple(sorted(position(code) for code in face))] += 1
                assert any(4 <= code < 16 for code in face)
        assert set(on_cut.values()) <= {2}


def test_complete_cases_make_two_pieces_and_partial_ones_one(decompositions):
    for edges, nodes, _, tets in decompositions:
        links = [owners for owners in faces_of(tets).values() if len(owners) == 2]
        complete = bool(IS_COMPLETE[STATE[edges, nodes]])
        assert components(len(tets), links) == (2 if complete else 1)


def test_only_nodes_on_the_cut_are_parted_within_an_element(decompositions):
    for edges, nodes, _, tets in decompositions:
        for code in {code for tet in tets for code in tet if code < 20}:
            star = [tet for tet in tets if code in tet]
            links = [
                owners
                for face, owners in faces_of(star).items()
                if len(owners) == 2 and code in face
            ]
            complete = bool(IS_COMPLETE[STATE[edges, nodes]])
            parted = code < 4 and nodes >> code & 1 and complete
            assert components(len(star), links) == (2 if parted else 1)


@pytest.mark.long
def test_children_stay_positive_wherever_on_its_edge_or_face_a_new_node_lies():
    rng = np.random.default_rng(0)
    for edges, nodes in states():
        for rank in permutations(range(4)):
            where = {}
            for code in range(21):
                weights = [Fraction(int(i), 97) for i in rng.integers(1, 96, 4)]
                where[position(code)] = [
                    w * Fraction(p) for w, p in zip(weights, place(code), strict=True)
                ]
            for tet in children(edges, nodes, rank):
                assert determinant([where[position(code)] for code in tet]) > 0
