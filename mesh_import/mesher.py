"""Fill a closed surface with tetrahedra by fTetWild, in a separate process.

The mesher is native code: it may crash, and it ignores interrupts. The process runs
`python -m cutting_trainer.mesh_import.mesher IN.npz OUT.npz`.
"""

import os
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.session.errors import SessionError
from cutting_trainer.tissue_sim.mesh.checks import check_mesh

MAX_ATTEMPTS = 3
"""fTetWild is not deterministic: after a mesh that is no conforming solid, another may be one."""
INSTALL_HINT = (
    'this needs a mesher, which is not installed: run '
    '`./trainer run python -m pip install -r requirements-mesh.txt` (x86-64), or make a mesh of '
    'tetrahedra with another one and write a scene for it (docs/own-organ.md)'
)


def fill(
    vertices: NDArray[np.float64], triangles: NDArray[np.int32], edge: float, envelope: float
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Fill a closed surface.

    Args:
        vertices: [m], shape (v, 3).
        triangles: shape (t, 3).
        edge: target edge length [m].
        envelope: allowed motion of the surface [m].

    Returns:
        nodes [m], shape (n, 3), and tetrahedra that `check_mesh` accepts, shape (m, 4).

    Raises:
        SessionError: the mesher is not installed, or fails.
    """
    if find_spec('pytetwild') is None:
        raise SessionError(INSTALL_HINT)
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    reason = ''
    environment = os.environ | {'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
    with tempfile.TemporaryDirectory(prefix='trainer-') as folder:
        given, made = Path(folder, 'surface.npz'), Path(folder, 'solid.npz')
        np.savez(
            given, vertices=vertices, triangles=triangles, edge=edge, epsilon=envelope / diagonal
        )
        for _ in range(MAX_ATTEMPTS):
            command = [
                sys.executable,
                '-m',
                'cutting_trainer.mesh_import.mesher',
                str(given),
                str(made),
            ]
            # The mesher leaves a file in its working directory.
            done = subprocess.run(
                command, cwd=folder, env=environment, capture_output=True, text=True, check=False
            )
            if done.returncode:
                reason = (done.stderr.strip().splitlines() or [f'status {done.returncode}'])[-1]
                continue
            with np.load(made) as solid:
                nodes, tetrahedra = solid['nodes'], solid['tetrahedra']
            try:
                return reorder_nodes(nodes, check_mesh(nodes, tetrahedra))
            except MeshError as error:
                reason = str(error)
    raise SessionError(
        f'no mesh could be made with edges of {1e3 * edge:.3g} mm: {reason}; try another --edge, '
        'or smooth and simplify the surface'
    )


def reorder_nodes(
    nodes: NDArray[np.float64], tetrahedra: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Renumber a mesh so that neighbours are near each other in memory.

    Nodes are in reverse Cuthill-McKee order, tetrahedra in the order of their first node. In the
    order of the mesher, the force of 150,000 tetrahedra takes a quarter to a half longer.

    Args:
        nodes: [m], shape (n, 3).
        tetrahedra: shape (m, 4).
    """
    pairs = np.repeat(tetrahedra, 4, axis=1).ravel(), np.tile(tetrahedra, 4).ravel()
    graph = csr_matrix((np.ones(len(pairs[0]), np.int8), pairs), shape=2 * (len(nodes),))
    order = reverse_cuthill_mckee(graph, symmetric_mode=True)
    number = np.empty(len(nodes), np.int32)
    number[order] = np.arange(len(nodes), dtype=np.int32)
    corners = number[tetrahedra]
    return nodes[order], corners[np.argsort(corners.min(axis=1), kind='stable')]


def _run(given: str, made: str) -> None:
    import pytetwild

    with np.load(given) as surface:
        nodes, tetrahedra = pytetwild.tetrahedralize(
            surface['vertices'],
            surface['triangles'],
            edge_length_abs=float(surface['edge']),
            epsilon=float(surface['epsilon']),
            stop_energy=8.0,
            coarsen=True,
            num_threads=1,
            vtk_ordering=True,
            quiet=True,
        )
    used, renumbered = np.unique(tetrahedra, return_inverse=True)
    np.savez(
        made, nodes=nodes[used], tetrahedra=renumbered.reshape(tetrahedra.shape).astype(np.int32)
    )


if __name__ == '__main__':
    _run(*sys.argv[1:])
