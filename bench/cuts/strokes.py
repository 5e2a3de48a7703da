"""Meshes and strokes of a blade through them, for the comparison of methods of cutting."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.cutting.method_interface import CutMethod, CutResult
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.assembly import load_tissue
from cutting_trainer.tissue_sim.contact.blade import Sweep
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

Floats = NDArray[np.float64]

CELL_M = 0.005
"""Edge length of the cubes of a block."""


@dataclass(frozen=True)
class Stroke:
    """A mesh and a path of the blade through it.

    Attributes:
        name: of both.
        nodes: [m], shape (n, 3).
        tetrahedra: shape (m, 4).
        fixed: nodes that do not move, shape (n,).
        paths: the blade's edge, root and tip, by step [m], each shape (k, 2, 3).
    """

    name: str
    nodes: Floats
    tetrahedra: NDArray[np.int64]
    fixed: NDArray[np.uint8]
    paths: tuple[Floats, ...]


def results_along(
    method: CutMethod,
    mesh: TetMesh,
    path: Floats,
    positions: Callable[[], Floats] | None = None,
) -> Iterator[CutResult]:
    """Draw a blade along a path, and end the stroke.

    Args:
        method: of cutting.
        mesh: the tissue; whoever asks for the next result has applied the last one.
        path: root and tip of the blade [m], shape (k, 2, 3).
        positions: gives those of the nodes [m], shape (n, 3); None: at rest.

    Yields:
        The result of each sweep, then that of the end.
    """
    for a, b in pairwise(path):
        now = mesh.rest if positions is None else positions()
        yield method.advance(mesh, now, Sweep(*a, *b))
    yield method.finish(mesh, mesh.rest if positions is None else positions())


def strokes() -> tuple[Stroke, ...]:
    """Return an oblique plane, an arc and two crossing cuts in a block; a plane in the liver."""
    nodes, tetrahedra = good_block((8, 6, 6), CELL_M, seed=0)
    free = np.zeros(len(nodes), np.uint8)
    middle = nodes.mean(axis=0)
    slant = drawn(_line(middle, 62.0, 0.040), (0.25, 0.15, 1.0), 0.030)
    bend = drawn(_arc(middle, 25.0, 0.040), (0.1, 0.2, 1.0), 0.030)
    across = drawn(_line(middle, -21.0, 0.040), (-0.1, 0.2, 1.0), 0.030)
    liver, inside, held, _ = load_tissue(load_scene('liver').tissue)
    through = drawn(_line(np.array([-0.02, 0.0, 0.035]), 83.0, 0.060), (0.1, 0.0, 1.0), 0.015)
    return (
        Stroke('plane', nodes, tetrahedra, free, (slant,)),
        Stroke('arc', nodes, tetrahedra, free, (bend,)),
        Stroke('crossing', nodes, tetrahedra, free, (slant, across)),
        Stroke('liver', liver, inside.astype(np.int64), held.astype(np.uint8), (through,)),
    )


def random_planes() -> tuple[Stroke, ...]:
    """Return planes of any direction through the block, 30, and through the liver, 12."""
    found: list[Stroke] = []
    liver, inside, *_ = load_tissue(load_scene('liver').tissue)
    for name, count in (('block', 30), ('liver', 12)):
        for k in range(count):
            rng = np.random.default_rng(k)
            if name == 'block':
                nodes, tetrahedra = good_block((8, 6, 6), CELL_M, seed=k)
            else:
                nodes, tetrahedra = liver, inside.astype(np.int64)
            low, high = nodes.min(axis=0), nodes.max(axis=0)
            through = low + (high - low) * rng.uniform(0.3, 0.7, 3)
            along, edge, _ = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            line = through + np.linspace(-0.048, 0.048, 61)[:, None] * along
            free = np.zeros(len(nodes), np.uint8)
            path = drawn(line, (edge[0], edge[1], edge[2]), 0.048)
            found.append(Stroke(name, nodes, tetrahedra, free, (path,)))
    return tuple(found)


def good_block(
    cells: tuple[int, int, int], size: float, *, seed: int, jitter: float = 0.08
) -> tuple[Floats, NDArray[np.int64]]:
    """Return a block of body-centred cubes, its inner nodes displaced, its numbers shuffled.

    Args:
        cells: cubes along each axis.
        size: edge of a cube [m].
        seed: of the displacements and the numbers; negative: numbers in order.
        jitter: largest displacement along each axis, as a share of `size`.

    Returns:
        Nodes [m], shape (n, 3), and positively oriented tetrahedra, 12 by cube, shape (m, 4).
    """
    corner = np.arange(np.prod([c + 1 for c in cells])).reshape([c + 1 for c in cells])
    grid = np.argwhere(np.ones(cells)).astype(float)
    nodes = np.concatenate([np.argwhere(corner >= 0).astype(float), grid + 0.5]) * size
    heart = np.full(np.array(cells) + 2, -1)
    heart[1:-1, 1:-1, 1:-1] = corner.size + np.arange(len(grid)).reshape(cells)
    parts = []
    for axis in range(3):
        c, h = np.moveaxis(corner, axis, 0), np.moveaxis(heart, axis, 0)
        ring = np.stack([c[:, :-1, :-1], c[:, 1:, :-1], c[:, 1:, 1:], c[:, :-1, 1:]], axis=-1)
        ends = np.stack([h[:-1, 1:-1, 1:-1], h[1:, 1:-1, 1:-1]], axis=-1).reshape(-1, 2)
        ring = ring.reshape(-1, 4)
        inner = (ends >= 0).all(axis=1)
        for i in range(4):
            sides = np.stack([ring[:, i], ring[:, (i + 1) % 4]], axis=1)
            parts.append(np.concatenate([ends, sides], axis=1)[inner])
        for three in ((0, 1, 2), (0, 2, 3)):
            apex = ends.max(axis=1)[:, None]
            parts.append(np.concatenate([apex, ring[:, three]], axis=1)[~inner])
    inside = ((nodes > size / 4) & (nodes < (np.array(cells) - 0.25) * size)).all(axis=1)
    # A function of the place, so that blocks of any size agree where they overlap.
    wave = np.sin(
        nodes @ (np.array([[1.3, 2.1, 3.7], [2.9, 1.7, 0.9], [0.7, 3.1, 2.3]]) / size * 5)
    )
    nodes[inside] += jitter * size * wave[inside]
    return _shuffled(nodes, np.concatenate(parts), seed)


def _shuffled(
    nodes: Floats, tetrahedra: NDArray[np.int64], seed: int
) -> tuple[Floats, NDArray[np.int64]]:
    if seed >= 0:
        rng = np.random.default_rng(seed)
        order = rng.permutation(len(nodes))
        nodes = nodes[order]
        tetrahedra = rng.permutation(np.argsort(order)[tetrahedra])
    a, b, c, d = (nodes[tetrahedra[:, i]] for i in range(4))
    negative = np.einsum('ij,ij->i', np.cross(b - a, c - a), d - a) < 0
    tetrahedra[negative, 2:] = tetrahedra[negative, :1:-1]
    return nodes, tetrahedra


def _line(middle: Floats, degrees: float, length: float) -> Floats:
    angle = np.radians(degrees)
    way = np.linspace(-length, length, 61)[:, None]
    return middle + way * np.array([np.cos(angle), np.sin(angle), 0.0])


def _arc(middle: Floats, degrees: float, radius: float) -> Floats:
    angle = np.linspace(-1.0, 1.0, 61)
    bow = radius * np.stack([1 - np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    turn = np.radians(degrees)
    c, s = np.cos(turn), np.sin(turn)
    return middle + (bow - [0.1 * radius, 0.0, 0.0]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def drawn(line: Floats, edge: tuple[float, float, float], reach: float) -> Floats:
    """Return a straight blade drawn along a line.

    Args:
        line: middle of the edge by step [m], shape (k, 3).
        edge: its direction.
        reach: half its length [m].

    Returns:
        Root and tip by step [m], shape (k, 2, 3).
    """
    half = np.array(edge) / np.linalg.norm(edge) * reach
    return np.stack([line + half, line - half], axis=1)
