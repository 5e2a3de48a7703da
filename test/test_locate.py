"""The nearest triangle is the one that looking at all of them finds."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cutting_trainer.tissue_sim.mesh.locate import closest_triangle, distance_to_triangles

coordinate = st.integers(-4, 4).map(lambda k: 0.01 * k)
"""On a lattice: points lie in planes, edges and corners of triangles, and as far from several."""
point = st.tuples(coordinate, coordinate, coordinate)


def distance(p: np.ndarray, corners: np.ndarray) -> float:
    """Of a point to a triangle, by the projections on its plane, its edges and its corners."""
    a, b, c = corners
    found = [np.linalg.norm(p - corner) for corner in corners]
    for start, end in ((a, b), (b, c), (c, a)):
        way = end - start
        if way @ way > 0:
            share = np.clip((p - start) @ way / (way @ way), 0, 1)
            found.append(np.linalg.norm(p - start - share * way))
    normal = np.cross(b - a, c - a)
    if normal @ normal > 0:
        foot = p - (p - a) @ normal / (normal @ normal) * normal
        sides = [np.cross(e - s, foot - s) @ normal for s, e in ((a, b), (b, c), (c, a))]
        if min(sides) >= 0:
            found.append(np.linalg.norm(p - foot))
    return float(min(found))


@given(
    st.lists(point, min_size=4, max_size=12, unique=True),
    st.lists(st.tuples(*3 * [st.integers(0, 3)]), min_size=1, max_size=20),
    point,
)
def test_triangles_in_boxes_farther_away_are_rightly_not_looked_at(
    corners: list[tuple[float, ...]], triangles: list[tuple[int, ...]], at: tuple[float, ...]
) -> None:
    nodes, here = np.array(corners), np.array(at)
    faces = np.array([t for t in triangles if len(set(t)) == 3] or [(0, 1, 2)], np.int32)
    away = np.array([distance(here, nodes[face]) for face in faces])
    found = closest_triangle(here, nodes, faces)
    assert away[found] <= away.min() + 1e-12
    assert abs(distance_to_triangles(here, nodes, faces) - away.min()) < 1e-12
