"""Reader of tetrahedral mesh files: Gmsh .msh, .vtk, .vtu, .mesh and other formats of meshio."""

import contextlib
import io
import logging
from collections import Counter
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.node_common.scene_reader import missing_file

_log = logging.getLogger(__name__)


_LABELS = ('gmsh:physical', 'medit:ref', 'cell_tags', 'region', 'label')
"""Names of the data of cells that say to which region they belong, the first that a file has."""


def load_mesh(path: Path, unit_scale: float) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Read the four-node tetrahedra of a file, without their labels.

    Arguments, result and errors: see `load_labelled_mesh`.
    """
    return _solid(path, _read(path), unit_scale)


def load_labelled_mesh(
    path: Path, unit_scale: float
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int64]]:
    """Read the four-node tetrahedra of a file.

    All blocks of tetrahedra become one, in the file's order. Points, lines and surface elements are
    ignored: meshers write them beside the volume. Nodes that no tetrahedron uses (centres of arcs,
    nodes of ignored surfaces) are dropped with a warning, the others keep their order.

    Args:
        path: the file; its extension decides the format.
        unit_scale: metres per unit of the file.

    Returns:
        nodes [m], shape (n, 3), and tetrahedra, shape (m, 4), not yet checked by `check_mesh`;
        their labels, such as physical groups of Gmsh, shape (m,): 0 where the file has none.

    Raises:
        MeshError: the file is unreadable or has elements other than such tetrahedra.
    """
    mesh = _read(path)
    return *_solid(path, mesh, unit_scale), _labels(path, mesh)


def _solid(
    path: Path, mesh: Any, unit_scale: float
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return the used nodes [m] and the tetrahedra of a mesh that was read."""
    tetrahedra = _tetrahedra(path, mesh)
    points = np.asarray(mesh.points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshError(f'{path}: points have the shape {points.shape}: a solid needs x, y and z')
    outside = np.flatnonzero((tetrahedra < 0).any(1) | (tetrahedra >= len(points)).any(1))
    if len(outside):
        raise MeshError(
            f'{path}: tetrahedron {outside[0]} has the nodes {tetrahedra[outside[0]].tolist()}, '
            f'but the file has the nodes 0 to {len(points) - 1}: export the mesh again'
        )
    used = np.zeros(len(points), bool)
    used[tetrahedra] = True
    if not used.all():
        orphans = np.flatnonzero(~used)
        _log.warning(
            '%s: %d nodes belong to no tetrahedron and are dropped, the first is node %d at %s',
            path,
            len(orphans),
            orphans[0],
            points[orphans[0]].tolist(),
        )
    renumbered = np.cumsum(used, dtype=np.int32) - 1
    return points[used] * unit_scale, renumbered[tetrahedra].astype(np.int32)


def _read(path: Path) -> Any:
    if not path.is_file():
        raise MeshError(f'mesh file {missing_file(path)}')
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            return meshio.read(path)
    # meshio ends the process where no reader fits, and its readers let through whatever their
    # parsing raised: IndexError, KeyError, struct.error and so on.
    except (Exception, SystemExit) as error:
        reason = f'{said.getvalue()} {"" if isinstance(error, SystemExit) else error}'
        reason = ' '.join(reason.split()) or type(error).__name__
        raise MeshError(
            f'{path} cannot be read as a mesh: {reason[:200]}; export it as Gmsh .msh, .vtk or '
            '.vtu, with the extension of its format'
        ) from None


def _tetrahedra(path: Path, mesh: Any) -> NDArray[np.int64]:
    counts: Counter[str] = Counter()
    for block in mesh.cells:
        counts[block.type] += len(block.data)
    solids = {b.type for b in mesh.cells if b.dim == 3 and b.type != 'tetra' and len(b.data)}
    if solids:
        found = ', '.join(f'{counts[kind]} {kind}' for kind in sorted(solids))
        raise MeshError(
            f'{path} holds {found}: only four-node tetrahedra can be simulated: mesh the solid '
            'again with tetrahedra of first order'
        )
    if not counts['tetra']:
        found = ', '.join(f'{n} {kind}' for kind, n in sorted(counts.items()) if n) or 'no cells'
        raise MeshError(
            f'{path} holds no tetrahedra but {found}: fill the surface by a mesher such as Gmsh or '
            'fTetWild'
        )
    ignored = {kind: n for kind, n in counts.items() if kind != 'tetra'}
    if ignored:
        _log.info('%s: ignored beside the tetrahedra: %s', path, ignored)
    blocks = [b.data for b in mesh.cells if b.type == 'tetra' and len(b.data)]
    return np.concatenate(blocks).astype(np.int64)


def _labels(path: Path, mesh: Any) -> NDArray[np.int64]:
    """Return the labels of the tetrahedra; 0 where the file has none."""
    wanted = [i for i, b in enumerate(mesh.cells) if b.type == 'tetra' and len(b.data)]
    for name in _LABELS:
        if name in mesh.cell_data:
            values = np.concatenate([np.asarray(mesh.cell_data[name][i]).ravel() for i in wanted])
            whole = np.isfinite(values).all() and (np.abs(values) < 2**31).all()
            labels = values.astype(np.int64) if whole else np.zeros(0, np.int64)
            if (
                len(labels) != sum(len(mesh.cells[i].data) for i in wanted)
                or (labels != values).any()
            ):
                raise MeshError(
                    f'{path}: the data {name} of the cells are no labels: each tetrahedron needs '
                    'one whole number below 2^31'
                )
            return np.asarray(labels)
    return np.zeros(sum(len(mesh.cells[i].data) for i in wanted), np.int64)
