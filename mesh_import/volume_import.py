"""Import of a mesh of tetrahedra: its elements and their labels stay as they are."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.mesh_import.surface_import import Surface
from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.session.errors import SessionError
from cutting_trainer.tissue_sim.mesh.checks import EDGES, check_mesh, components
from cutting_trainer.tissue_sim.mesh.files import load_labelled_mesh
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.scene_schema import MAX_REGIONS, UNIT_SCALE

_SUFFIXES = ('.msh', '.vtu', '.vtk', '.mesh', '.inp')
"""Of files that hold solids; a surface comes as STL, PLY or OBJ."""


@dataclass(frozen=True)
class Volume:
    """Tetrahedra of a file.

    Attributes:
        nodes: [m], shape (n, 3).
        tetrahedra: positively oriented, shape (m, 4).
        labels: shape (m,).
    """

    nodes: NDArray[np.float64]
    tetrahedra: NDArray[np.int32]
    labels: NDArray[np.int64]

    @property
    def edge(self) -> float:
        """Mean length of the edges [m]."""
        ends = self.nodes[self.tetrahedra[:, EDGES]]
        return float(np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2).mean())

    def surface(self, nodes: NDArray[np.float64]) -> Surface:
        """Return the surface, with the nodes at other places [m], shape (n, 3)."""
        mesh = TetMesh(nodes, self.tetrahedra)
        triangles = np.array(mesh.triangles, np.int32)
        _, part = components(len(nodes), triangles[:, [0, 1, 1, 2]].reshape(-1, 2))
        shells = len(np.unique(part[triangles[:, 0]]))
        return Surface(nodes, triangles, float(mesh.volumes().sum()), shells, ())


def is_volume(path: Path) -> bool:
    """Return whether a file holds tetrahedra, by its suffix."""
    return path.suffix.lower() in _SUFFIXES


def read_volume(path: Path, unit: str, edge: float | None) -> Volume:
    """Read the tetrahedra of a file.

    Args:
        path: a format of meshio.
        unit: unit of length of the file: m, cm or mm.
        edge: length of edge asked for [m]; None: none.

    Raises:
        SessionError: one sentence with the file, the defect, and its remedy.
    """
    try:
        nodes, tetrahedra, labels = load_labelled_mesh(path, UNIT_SCALE[unit])
        if edge is not None:
            raise MeshError('it holds tetrahedra, which stay as they are: leave --edge out')
        if (count := len(np.unique(labels))) > MAX_REGIONS + 1:
            raise MeshError(
                f'{count} labels: a scene takes {MAX_REGIONS} regions and the rest; join some'
            )
        return Volume(nodes, check_mesh(nodes, tetrahedra), labels)
    except MeshError as error:
        text = str(error)
        raise SessionError(text if str(path) in text else f'{path}: {text}') from None
