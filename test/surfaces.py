"""Test surfaces and a distance that shares nothing with the code under test."""

import numpy as np


def grid(points, height=None):
    """Square of 0.1 m of 2 (points - 1)^2 triangles, outward +z; height [m] as a function."""
    line = np.linspace(-0.05, 0.05, points)
    x, y = (a.ravel() for a in np.meshgrid(line, line, indexing='ij'))
    z = np.zeros_like(x) if height is None else height(x, y)
    index = np.arange(points**2).reshape(points, points)
    a, b, c, d = (
        a.ravel() for a in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    )
    return np.column_stack([x, y, z]), np.vstack(
        [np.column_stack(t) for t in ((a, b, c), (a, c, d))]
    )


def slab(size, low, high):
    """A closed box, size [m] in x and y, from low to high [m] in z; 12 triangles."""
    h = size / 2
    corners = [(x, y, z) for z in (low, high) for y in (-h, h) for x in (-h, h)]
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return np.array(corners), np.array(triangles)


def joined(*meshes):
    """Several (positions, triangles) as one."""
    offsets = np.cumsum([0] + [len(p) for p, _ in meshes])
    triangles = [t + o for (_, t), o in zip(meshes, offsets, strict=False)]
    return np.vstack([p for p, _ in meshes]), np.vstack(triangles)


def distance(positions, triangles, point):
    """Least distance of a point from triangles [m], by brute force."""
    return distances(positions, triangles, point).min()


def distances(positions, triangles, point):
    """Distance of a point from each triangle [m], by brute force."""
    a, b, c = (positions[triangles[:, i]] for i in range(3))
    edges = [_from_segments(p, q, point) for p, q in ((a, b), (b, c), (c, a))]
    normal = np.cross(b - a, c - a)
    size = np.linalg.norm(normal, axis=1)
    normal = normal / np.where(size > 0, size, 1)[:, None]
    inside = size > 0
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= np.einsum('ij,ij->i', np.cross(normal, q - p), point - p) >= 0
    height = np.abs(np.einsum('ij,ij->i', normal, point - a))
    return np.min([*edges, np.where(inside, height, np.inf)], axis=0)


def _from_segments(a, b, point):
    edge = b - a
    length2 = np.einsum('ij,ij->i', edge, edge)
    along = np.einsum('ij,ij->i', edge, point - a)
    t = np.clip(along / np.where(length2 > 0, length2, 1), 0, 1)
    return np.linalg.norm(point - a - t[:, None] * edge, axis=1)
