"""Import of a closed surface: read it, repair it where that is safe, or reject it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh import repair

from cutting_trainer.node_common.scene_reader import missing_file
from cutting_trainer.session.errors import SessionError
from cutting_trainer.tissue_sim.mesh.checks import MAX_SIZE, MIN_SIZE
from cutting_trainer.tissue_sim.scene_schema import UNIT_SCALE

MAX_TRIANGLES = 500_000
MAX_HOLE_EDGES = 4
"""Largest hole to fill: a missing triangle or quadrilateral, not a missing side."""


@dataclass(frozen=True)
class Surface:
    """Closed surface with outward normals.

    Attributes:
        vertices: [m], shape (v, 3).
        triangles: vertex indices, shape (t, 3).
        volume: enclosed volume [m^3].
        parts: number of separate shells.
        mended: sentences on repaired defects.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]
    volume: float
    parts: int
    mended: tuple[str, ...]

    @property
    def size(self) -> NDArray[np.float64]:
        """Size of the bounding box [m], shape (3,)."""
        return np.asarray(np.ptp(self.vertices, axis=0))


def read_surface(path: Path, unit: str) -> Surface:
    """Read a surface, repair unambiguous defects, reject others.

    Repaired are coincident vertices, flat or double triangles, holes of three or four edges, and
    triangles or a whole surface with inward normals.

    Args:
        path: STL, PLY, OBJ or another format of trimesh.
        unit: unit of length of the file: m, cm or mm.

    Raises:
        SessionError: one sentence with the file, the defect, and its remedy.
    """
    mesh = _load(path)
    _check_content(path, mesh)
    mesh.apply_scale(UNIT_SCALE[unit])
    _check_size(path, mesh, unit)
    mended = _clean(mesh)
    if not mesh.is_watertight and repair_holes(mesh):
        mended.append('holes of three or four edges were filled')
    _check_closed(path, mesh)
    mended += _orient(path, mesh)
    return Surface(
        np.asarray(mesh.vertices, np.float64),
        np.asarray(mesh.faces, np.int32),
        float(mesh.volume),
        int(mesh.body_count),
        tuple(mended),
    )


def _load(path: Path) -> Any:
    if not path.is_file():
        raise SessionError(f'surface {missing_file(path)}')
    if path.stat().st_size == 0:
        raise SessionError(f'{path} is empty: export the surface again')
    try:
        return trimesh.load_mesh(path, process=False)
    # Readers raise exceptions of any type.
    except Exception as error:
        reason = ' '.join(str(error).split())[:150] or type(error).__name__
        if isinstance(error, ImportError):
            reason = 'its content is of no format that is known, or cut off'
        elif isinstance(error, KeyError):
            reason = f'it lacks {reason}'
        known = 'export it as STL, PLY or OBJ, with the extension of its format'
        raise SessionError(f'{path} cannot be read as a surface: {reason}; {known}') from None


def _check_content(path: Path, mesh: Any) -> None:
    faces = getattr(mesh, 'faces', None)
    if not isinstance(mesh, trimesh.Trimesh) or faces is None or not len(faces):
        raise SessionError(f'{path} holds no triangles: export a surface, not points or lines')
    bad = np.flatnonzero(~np.isfinite(mesh.vertices).all(axis=1))
    if len(bad):
        raise SessionError(
            f'{path}: vertex {bad[0]} is {mesh.vertices[bad[0]].tolist()} ({len(bad)} are not '
            'numbers): export the surface again'
        )
    if len(faces) > MAX_TRIANGLES:
        raise SessionError(
            f'{path} has {len(faces)} triangles, more than {MAX_TRIANGLES}: simplify it first, '
            'for example by quadric decimation in MeshLab or Blender'
        )


def _check_size(path: Path, mesh: Any, unit: str) -> None:
    longest = float(np.ptp(mesh.vertices, axis=0).max())
    if MIN_SIZE <= longest <= MAX_SIZE:
        return
    raw = longest / UNIT_SCALE[unit]
    fitting = [u for u, s in UNIT_SCALE.items() if MIN_SIZE <= raw * s <= MAX_SIZE]
    hint = f'is it in {" or ".join(fitting)} (--unit)?' if fitting else 'scale it first'
    raise SessionError(
        f'{path} is {longest:.4g} m long in the unit {unit}, a tissue {MIN_SIZE:g} to '
        f'{MAX_SIZE:g} m: {hint}'
    )


def _clean(mesh: Any) -> list[str]:
    mended = []
    vertices, triangles = len(mesh.vertices), len(mesh.faces)
    mesh.merge_vertices()
    # STL has three vertices for each triangle; that is its format and no defect.
    if vertices != 3 * triangles and len(mesh.vertices) < vertices:
        mended.append(f'{vertices - len(mesh.vertices)} vertices that lay on others were merged')
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    if len(mesh.faces) < triangles:
        mended.append(f'{triangles - len(mesh.faces)} triangles, flat or double, were taken out')
    mesh.remove_unreferenced_vertices()
    return mended


def repair_holes(mesh: Any) -> bool:
    """Fill holes of at most `MAX_HOLE_EDGES` edges; return whether the surface is closed then."""
    if any(len(loop) > MAX_HOLE_EDGES for loop in _rims(mesh)):
        return False
    return bool(repair.fill_holes(mesh))


def _open_edges(mesh: Any) -> NDArray[np.int64]:
    """Return the edges that do not have two triangles, shape (e, 2)."""
    edges, counts = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    return np.asarray(edges[counts != 2])


def _rims(mesh: Any) -> list[NDArray[np.int64]]:
    """Return the vertices of each connected set of open edges."""
    edges = _open_edges(mesh)
    parts = trimesh.graph.connected_components(edges, nodes=np.unique(edges), min_len=1)
    return [np.asarray(part) for part in parts]


def _check_closed(path: Path, mesh: Any) -> None:
    if mesh.is_watertight:
        return
    edges, rims = _open_edges(mesh), _rims(mesh)
    largest = max(rims, key=len)
    place = ', '.join(f'{x:.4g}' for x in mesh.vertices[largest].mean(axis=0))
    raise SessionError(
        f'{path} is not closed: {len(edges)} edges without two triangles, around {len(rims)} holes '
        f'or seams, the largest of {len(largest)} vertices near ({place}) m: close it where the '
        "surface was made (for example MeshLab, 'Close Holes'), or delete loose triangles"
    )


_SHELL_SAMPLES = 18
"""Triangles of a shell, beside its extremes, to test against every other shell."""


def _orient_shells(path: Path, mesh: Any) -> None:
    """Orient shells so that normals leave the solid: outward, but inward around a cavity.

    Raises:
        SessionError: two shells cross each other.
    """
    count = len(mesh.faces)
    labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=count)
    faces = np.array(mesh.faces)
    corners = mesh.vertices[faces]
    volumes = np.linalg.det(corners) / 6
    shells = [np.flatnonzero(labels == label) for label in np.unique(labels)]
    for shell in shells:
        centres = corners[shell].mean(axis=1)
        ends = [*centres.argmin(axis=0), *centres.argmax(axis=0)]
        points = centres[[*ends, *np.linspace(0, len(shell) - 1, _SHELL_SAMPLES, dtype=int)]]
        around = 0
        for other in (corners[s] for s in shells if s is not shell):
            within = np.array([abs(_winding(other, point)) > 0.5 for point in points])
            if within.any() and not within.all():
                place = ', '.join(f'{x:.4g}' for x in points[within.argmax()])
                raise SessionError(
                    f'{path}: two of its {len(shells)} shells cross each other, one is inside the '
                    f'other at ({place}) m: unite them where the surface was made (for example '
                    "MeshLab, 'Mesh Boolean: Union')"
                )
            around += int(within[0])
        wanted = 1 if around % 2 == 0 else -1
        if volumes[shell].sum() * wanted < 0:
            faces[shell] = faces[shell][:, ::-1]
    mesh.faces = faces


def _winding(corners: NDArray[np.float64], point: NDArray[np.float64]) -> float:
    """Return the winding number of a closed shell about a point: its solid angle over 4 pi.

    The formula is that of Van Oosterom and Strackee (IEEE Trans. Biomed. Eng. 30, 1983).
    """
    a, b, c = np.moveaxis(corners - point, 1, 0)
    na, nb, nc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    ab, bc, ca = (np.einsum('ij,ij->i', x, y) for x, y in ((a, b), (b, c), (c, a)))
    volume = np.einsum('ij,ij->i', a, np.cross(b, c))
    angles = 2 * np.arctan2(volume, na * nb * nc + ab * nc + bc * na + ca * nb)
    return float(angles.sum() / (4 * np.pi))


def _normals(mesh: Any) -> NDArray[np.float64]:
    """Return normals by the order of the vertices; those of trimesh may come from the file."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def _orient(path: Path, mesh: Any) -> list[str]:
    mended = []
    before = _normals(mesh)
    if not mesh.is_winding_consistent:
        repair.fix_winding(mesh)
        if not mesh.is_winding_consistent:
            raise SessionError(
                f'{path} has no inside and outside: triangles that share an edge cannot be turned '
                'alike, it crosses itself or is one-sided; make it anew as the border of a solid'
            )
    _orient_shells(path, mesh)
    turned = int((np.einsum('ij,ij->i', before, _normals(mesh)) < 0).sum())
    if turned:
        whole = ', the whole surface' if turned == len(mesh.faces) else ''
        mended.append(f'{turned} triangles that faced inward were turned{whole}')
    if not mesh.volume > 1e-6 * float(np.prod(np.ptp(mesh.vertices, axis=0))):
        raise SessionError(
            f'{path} encloses no volume ({mesh.volume:.3g} m^3): it is flat or folded; make it '
            'anew as the border of a solid'
        )
    return mended
