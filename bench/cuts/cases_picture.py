"""The cases of the tables of cutting as a picture: docs/images/cut-cases.png."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from cutting_trainer.cutting.geometry import EDGE_NODES
from cutting_trainer.cutting.subdivision_cases import (
    CHILDREN,
    FRONT,
    INSIDE,
    LABEL_FACES,
    MID,
    NAMES,
    NUMBER,
    STATE,
)
from cutting_trainer.tissue_sim.mesh.topology import FACE_NODES

Floats = NDArray[np.float64]

_SHOWN = ('A', 'B', 'C', 'D', 'E', 'F', 'G', 'H', 'S', 'star')
_WORDS = (('edge', 'edges'), ('node', 'nodes'), ('', 'tetrahedra'), ('piece', 'pieces'))
_CORNERS = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(8)
"""Regular tetrahedron, its edges of length 1, shape (4, 3)."""
_SHRUNK, _OPENED = 0.88, 0.14
_TISSUE, _CUT, _MARK = np.array([0.90, 0.70, 0.62]), np.array([0.66, 0.05, 0.10]), '#1f4e8c'
_LIGHT = np.array([-0.35, -0.75, 0.55])
_ELEVATION, _AZIMUTH = 24.0, -64.0  # [deg]
_HEADING = (
    'Cases of a cut tetrahedron, their children moved apart. Red: faces opened by the cut.  '
    '\u25cf: edge crossed by the blade.  \u25c6: node on the cut.'
)


class _Case(NamedTuple):
    """Content of a panel: m children, corners by label."""

    children: NDArray[np.int64]  # labels, shape (m, 4)
    points: Floats  # by label, in edges of the parent, shape (l, 3)
    moves: Floats  # by label, away from the cut, shape (l, 3)
    outer: NDArray[np.uint8]  # by label, bits of the parent's faces it lies in, shape (l,)
    crossed: list[int]  # edges
    on_cut: list[int]  # nodes


def write_cases(folder: Path) -> None:
    """Draw the cases into `images/cut-cases.png` of a folder that has `images`."""
    draw().savefig(folder / 'images' / 'cut-cases.png', dpi=110)


def draw() -> Figure:
    """Return the figure: one panel for each case."""
    figure = Figure(figsize=(15.0, 6.6), layout='constrained')
    figure.suptitle(_HEADING, fontsize=13)
    for k, name in enumerate(_SHOWN):
        axes: Any = figure.add_subplot(2, 5, k + 1, projection='3d', computed_zorder=False)
        case = _separation() if name == 'S' else _from_tables(name)
        opened, pieces = _parted(case)
        _draw_case(axes, case, opened, pieces)
        counts = (len(case.crossed), len(case.on_cut), len(case.children), int(pieces.max()) + 1)
        words = [f'{n} {forms[n > 1]}' for n, forms in zip(counts, _WORDS, strict=True) if n]
        title = f'{name}: {", ".join(words[:-2])},\n{", ".join(words[-2:])}'
        axes.set_title(title, fontsize=12)
    return figure


def _from_tables(name: str) -> _Case:
    state = NAMES.index(name)
    edges, nodes = (int(bits[0]) for bits in np.nonzero(np.equal(STATE, state)))
    order = int(np.flatnonzero(NUMBER[state])[0])
    points = np.zeros((INSIDE + 1, 3))
    points[:4] = _CORNERS
    points[MID:FRONT] = np.repeat(_CORNERS[EDGE_NODES].mean(axis=1), 2, axis=0)
    points[FRONT:INSIDE] = _CORNERS[FACE_NODES].mean(axis=1)
    moves = np.zeros_like(points)
    crossed = [e for e in range(6) if edges >> e & 1]
    for e in crossed:
        for side, node in enumerate(EDGE_NODES[e]):
            moves[MID + 2 * e + side] = _CORNERS[node] - points[MID + 2 * e]
            moves[node] += moves[MID + 2 * e + side]
    children = CHILDREN[state, order, : NUMBER[state, order]].astype(np.int64)
    on_cut = [i for i in range(4) if nodes >> i & 1]
    return _Case(children, points, moves, LABEL_FACES, crossed, on_cut)


def _separation() -> _Case:
    """Return two tetrahedra whose common face lies on the cut.

    The second has copies of its nodes.
    """
    tip = 2 * _CORNERS[1:].mean(axis=0) - _CORNERS[0]
    points = 0.75 * np.vstack([_CORNERS, _CORNERS[1:], tip])  # smaller, to fit
    moves = np.vstack([np.tile(_CORNERS[0], (4, 1)), np.tile(-_CORNERS[0], (4, 1))])
    children = np.array([[0, 1, 2, 3], [7, 4, 6, 5]])
    # Every label lies in the outer faces of its tetrahedron, and in no face only if on the cut.
    outer = np.array([14, 12, 10, 6, 12, 10, 6, 14], np.uint8)
    return _Case(children, points, moves, outer, [], [1, 2, 3])


def _parted(case: _Case) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return the cut faces, shape (4 m,), and the pieces of the children, shape (m,)."""
    faces = np.sort(case.children[:, FACE_NODES], axis=2).reshape(-1, 3)
    _, index, number = np.unique(faces, axis=0, return_inverse=True, return_counts=True)
    index = index.ravel()
    opened = (number[index] == 1) & (np.bitwise_and.reduce(case.outer[faces], axis=1) == 0)
    shares = coo_array((np.ones(len(faces)), (np.arange(len(faces)) // 4, index)))
    return opened, connected_components(shares @ shares.T)[1]


def _draw_case(
    axes: Any, case: _Case, opened: NDArray[np.bool_], pieces: NDArray[np.int64]
) -> None:
    offsets = case.moves[case.children]
    for piece in range(pieces.max() + 1) if pieces.max() else ():  # each moves as one
        offsets[pieces == piece] = offsets[pieces == piece].sum(axis=(0, 1))
    offsets /= np.maximum(np.linalg.norm(offsets, axis=2, keepdims=True), 1e-12)
    corners = (case.points[case.children] + _OPENED * offsets) @ _frame(case).T
    middles = corners.mean(axis=1, keepdims=True)
    corners = middles + _SHRUNK * (corners - middles)
    faces = corners[:, FACE_NODES].reshape(-1, 3, 3)
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colours = np.where(opened[:, None], _CUT, _TISSUE)
    colours *= 0.78 + 0.3 * np.clip(normals @ _LIGHT, -1, 1)[:, None]
    colours = np.column_stack([np.clip(colours, 0, 1), np.where(opened, 1.0, 0.45)])
    axes.add_collection3d(Poly3DCollection(faces, facecolors=colours, edgecolors='black', lw=0.5))
    marked = [(MID + 2 * e, 'o') for e in case.crossed] + [(i, 'D') for i in case.on_cut]
    copies = 32 * pieces[:, None] + case.children
    for label, marker in marked:
        here = np.abs(case.points[case.children] - case.points[label]).max(axis=2) < 1e-9
        for copy in np.unique(copies[here]):
            place = corners[copies == copy].mean(axis=0)
            axes.scatter(*place, color=_MARK, marker=marker, s=26, depthshade=False, zorder=5)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    x, y, z = (low + high)[:, None] / 2 + [-0.6, 0.6]  # of one size in all panels
    axes.set(xlim=x, ylim=y, zlim=z)
    axes.set_box_aspect((1, 1, 1), zoom=1.35)
    axes.set_proj_type('ortho')
    axes.view_init(elev=_ELEVATION, azim=_AZIMUTH)
    axes.set_axis_off()


def _frame(case: _Case) -> Floats:
    """Return a rotation of the opening to x and of the crossed part to the eye, shape (3, 3)."""
    across = np.linalg.svd(case.moves)[2][0]
    toward = sum((case.points[MID + 2 * e] for e in case.crossed), np.array([1e-6, 2e-6, 3e-6]))
    toward = toward - toward @ across * across
    toward /= np.linalg.norm(toward)
    ours = np.stack([across, toward, np.cross(across, toward)])
    front = np.array([0.0, -0.8, 0.6])
    there = np.stack([[1.0, 0, 0], front, np.cross([1.0, 0, 0], front)])
    return np.asarray(there.T @ ours)
