"""Small meshes that several tests share."""

import itertools

import numpy as np


def box(cells: tuple[int, int, int], size: float) -> tuple[np.ndarray, np.ndarray]:
    """A box of cubes, six tetrahedra each (Kuhn).

    Args:
        cells: number of cubes along each axis.
        size: edge of a cube [m].

    Returns:
        Nodes [m], shape (n, 3), and positively oriented tetrahedra, shape (m, 4).
    """
    shape = tuple(c + 1 for c in cells)
    nodes = np.argwhere(np.ones(shape)) * size
    index = np.arange(len(nodes)).reshape(shape)
    tets = []
    for corner in itertools.product(*(range(c) for c in cells)):
        for order in itertools.permutations(range(3)):
            at = list(corner)
            path = [index[tuple(at)]]
            for axis in order:
                at[axis] += 1
                path.append(index[tuple(at)])
            tets.append(path)
    return nodes, oriented(nodes, np.array(tets))


def oriented(nodes: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """The same tetrahedra with positive volumes."""
    a, b, c, d = (nodes[tets[:, i]] for i in range(4))
    negative = np.einsum('ij,ij->i', np.cross(b - a, c - a), d - a) < 0
    out = tets.copy()
    out[negative, 2:] = out[negative, :1:-1]
    return out


def irregular_box(
    cells: tuple[int, int, int], size: float, seed: int, jitter: float = 0.2
) -> tuple[np.ndarray, np.ndarray]:
    """A box with displaced inner nodes and shuffled node and element numbers."""
    rng = np.random.default_rng(seed)
    nodes, tets = box(cells, size)
    inner = ((nodes > 1e-9) & (nodes < np.array(cells) * size - 1e-9)).all(axis=1)
    nodes[inner] += rng.uniform(-jitter, jitter, (inner.sum(), 3)) * size
    order = rng.permutation(len(nodes))
    number = np.argsort(order)
    tets = number[tets][rng.permutation(len(tets))]
    return nodes[order], oriented(nodes[order], tets)
