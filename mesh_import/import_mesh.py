"""`trainer import-mesh`: make a mesh and a scene from an organ's surface or tetrahedra."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import meshio
import numpy as np
import trimesh
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from scipy.spatial import cKDTree

from cutting_trainer.mesh_import.imported_scene import require_thick, scene_text
from cutting_trainer.mesh_import.mesher import fill
from cutting_trainer.mesh_import.surface_import import Surface, read_surface
from cutting_trainer.mesh_import.volume_import import is_volume, read_volume
from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.assembly import make_simulation, make_task
from cutting_trainer.tissue_sim.contact.tool import Frame
from cutting_trainer.tissue_sim.mesh.checks import quality
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

Points = NDArray[np.float64]

DEFAULT_TETRAHEDRA = 4000
"""Target without a given edge length; runs at 30 Hz with a margin."""
MAX_TETRAHEDRA = 200_000
MAX_USUAL_SIZE_M = 0.5
"""Few organs exceed this size; a file in mm that is read as cm does."""
MAX_REAL_TIME_TETRAHEDRA = 20_000
"""A larger mesh is not expected to run at 30 Hz."""
SURFACE_SAMPLES = 200_000
ENVELOPE_EDGES = 0.15
"""Allowed motion of the surface, in edge lengths. With less, elements follow its triangles."""
MAX_MESH_DISTANCE_EDGES, MAX_SURFACE_DISTANCE_EDGES = 0.6, 1.2
"""Largest distance of the mesh border from the surface, and of the surface from the border, in edge
lengths: more than the envelope and the spacing of the compared points."""
SIDES = {'-z': (2, 1), '+z': (2, -1), '-y': (1, 1), '+y': (1, -1), '-x': (0, 1), '+x': (0, -1)}


@dataclass(frozen=True)
class ImportOptions:
    """Options of `import-mesh`.

    Attributes:
        surface: file of the surface, or of tetrahedra, which stay as they are.
        output: name or path of the mesh and scene to write, without an extension.
        unit: unit of length of the file.
        edge: target edge length [m]; None: chosen for `DEFAULT_TETRAHEDRA`.
        rests_on: side of the surface that is down and fixed, one of `SIDES`.
        as_json: print the report as JSON.
    """

    surface: Path
    output: Path
    unit: str
    edge: float | None
    rests_on: str
    as_json: bool


@dataclass(frozen=True)
class Report:
    """Key figures of the mesh. Lengths in m, volumes in m^3, angles in degrees."""

    surface: str
    watertight: bool
    mended: tuple[str, ...]
    parts: int
    size: tuple[float, ...]
    edge: float
    nodes: int
    tetrahedra: int
    fixed_nodes: int
    surface_volume: float
    mesh_volume: float
    surface_moved: float
    least_volume: float
    least_altitude: float
    dihedral_least: float
    dihedral_median: float
    radius_ratio_least: float
    radius_ratio_median: float
    substeps: int
    warnings: tuple[str, ...]
    mesh: str
    scene: str


def import_mesh(options: ImportOptions) -> Status:
    """Make mesh and scene, and print their quality.

    Raises:
        SessionError: the surface, or a file to write, is not valid.
    """
    console = Console(stderr=True, soft_wrap=True)
    labels = np.zeros(0, np.int64)
    if options.rests_on not in SIDES:
        raise SessionError(f'--rests-on {options.rests_on}: one of {", ".join(SIDES)}')
    mesh_file, scene_file = _files(options.output)
    with console.status(f'reading {options.surface}'):
        if is_volume(options.surface):
            solid = read_volume(options.surface, options.unit, options.edge)
            nodes, tetrahedra, labels = solid.nodes, solid.tetrahedra, solid.labels
            nodes = _placed(nodes, options.rests_on)
            surface, edge = solid.surface(nodes), solid.edge
        else:
            surface = read_surface(options.surface, options.unit)
            surface = replace(surface, vertices=_placed(surface.vertices, options.rests_on))
            edge = _edge(surface, options.edge)
    require_thick(options.surface, surface.size)
    given = _samples(surface)
    if not len(labels):
        with console.status(f'filling it with tetrahedra of {1e3 * edge:.2g} mm'):
            nodes, tetrahedra = fill(
                surface.vertices, surface.triangles, edge, ENVELOPE_EDGES * edge
            )
        nodes[:, 2] -= nodes[:, 2].min()
        _require_same_border(options.surface, given, nodes, tetrahedra, edge)
        labels = np.ones(len(tetrahedra), np.int64)
    mesh_file.parent.mkdir(parents=True, exist_ok=True)
    _write(mesh_file, nodes, tetrahedra, labels)
    text = scene_text(mesh_file.name, str(options.surface.name), nodes, tetrahedra, edge, labels)
    scene_file.write_text(text, encoding='utf-8')
    try:
        with console.status('examining the mesh'):
            report = _report(options, surface, given, edge, mesh_file, scene_file)
    except MeshError as error:
        raise SessionError(f'{error}; both files are written: edit {scene_file}') from None
    _print_report(report, as_json=options.as_json)
    return Status.OK


def _write(
    file: Path, nodes: Points, tetrahedra: NDArray[np.int32], labels: NDArray[np.int64]
) -> None:
    tags = {f'gmsh:{kind}': [labels] for kind in ('physical', 'geometrical')}
    mesh = meshio.Mesh(nodes, [('tetra', tetrahedra)], cell_data=tags)
    mesh.write(file, file_format='gmsh22', binary=False, float_fmt='.9g')


def _files(output: Path) -> tuple[Path, Path]:
    if output.suffix in ('.msh', '.yaml', '.yml', '.vtk', '.vtu', '.stl'):
        raise SessionError(
            f'--output {output}: give a name without an extension, {output.with_suffix("")}; '
            'NAME.msh and NAME.yaml are written'
        )
    if not output.name:
        raise SessionError('--output is empty: give a name without an extension, as my_organ')
    files = output.with_name(f'{output.name}.msh'), output.with_name(f'{output.name}.yaml')
    for file in files:
        if file.exists():
            raise SessionError(f'{file} exists: move it away, or give another --output')
    return files


def _placed(points: Points, rests_on: str) -> Points:
    """Rotate points so that `rests_on` is down; origin at the centre of the underside."""
    axis, sign = SIDES[rests_on]
    order = {2: [0, 1, 2], 1: [2, 0, 1], 0: [1, 2, 0]}[axis]
    vertices = points[:, order]
    if sign < 0:  # half a turn about x
        vertices = vertices * [1, -1, -1]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    origin = [*(low + high)[:2] / 2, low[2]]
    return np.asarray(vertices - origin)


def _edge(surface: Surface, asked: float | None) -> float:
    """Return the target edge length [m].

    Raises:
        SessionError: the requested one makes too many, or too few, tetrahedra.
    """

    def edge_for(tetrahedra: float) -> float:
        # a regular tetrahedron of edge a has the volume a^3 / (6 sqrt(2))
        return float((6 * np.sqrt(2) * surface.volume / tetrahedra) ** (1 / 3))

    if asked is None:
        return edge_for(DEFAULT_TETRAHEDRA)
    expected = 6 * np.sqrt(2) * surface.volume / asked**3
    if expected > MAX_TETRAHEDRA:
        raise SessionError(
            f'--edge {asked:g} would make about {expected:.3g} tetrahedra, more than '
            f'{MAX_TETRAHEDRA}: take at least {edge_for(MAX_TETRAHEDRA):.2g} m; 30 Hz needs '
            f'about {edge_for(DEFAULT_TETRAHEDRA):.2g} m'
        )
    if asked > surface.size.max() / 2:
        raise SessionError(
            f'--edge {asked:g} is more than half of the size, {surface.size.max():.3g} m: '
            f'take about {edge_for(DEFAULT_TETRAHEDRA):.2g} m'
        )
    return asked


def _report(
    options: ImportOptions,
    surface: Surface,
    given: cKDTree,
    edge: float,
    mesh_file: Path,
    scene_file: Path,
) -> Report:
    """Return the key figures of the files, read as a session reads them."""
    scene = load_scene(str(scene_file))
    task = make_task(scene.tissue)
    nodes, tetrahedra = task.mesh.rest, task.mesh.tetrahedra
    measured = quality(nodes, tetrahedra)
    volumes = task.mesh.volumes()
    frame = make_simulation(scene.tissue)[0].frame(None)
    border = nodes[np.unique(task.mesh.triangles)]
    meshed = not is_volume(options.surface)
    worst = float(measured.radius_ratio.min())
    warnings = _warnings(len(tetrahedra), worst, frame, surface, meshed=meshed)
    return Report(
        surface=str(options.surface),
        watertight=True,
        mended=surface.mended,
        parts=surface.parts,
        size=tuple(float(x) for x in surface.size),
        edge=edge,
        nodes=len(nodes),
        tetrahedra=len(tetrahedra),
        fixed_nodes=int(task.mesh.fixed.sum()),
        surface_volume=surface.volume,
        mesh_volume=float(volumes.sum()),
        surface_moved=float(given.query(border)[0].max()),
        least_volume=float(volumes.min()),
        least_altitude=float(measured.altitude.min()),
        dihedral_least=float(measured.dihedral.min()),
        dihedral_median=float(np.median(measured.dihedral)),
        radius_ratio_least=float(measured.radius_ratio.min()),
        radius_ratio_median=float(np.median(measured.radius_ratio)),
        substeps=frame.substeps,
        warnings=tuple(warnings),
        mesh=str(mesh_file),
        scene=str(scene_file),
    )


def _samples(surface: Surface) -> cKDTree:
    """Return points of a surface [m], including its vertices."""
    mesh = trimesh.Trimesh(surface.vertices, surface.triangles, process=False)
    samples, _ = trimesh.sample.sample_surface(mesh, SURFACE_SAMPLES, seed=0)
    return cKDTree(np.vstack((samples, surface.vertices)))


def _require_same_border(
    path: Path, given: cKDTree, nodes: Points, tetrahedra: NDArray[np.int32], edge: float
) -> None:
    """Reject a mesh whose border differs from the surface.

    For a surface that crosses itself, the mesher may find another inside without an error.

    Raises:
        SessionError: mesh border and surface are too far apart.
    """
    border = TetMesh(nodes, tetrahedra, np.zeros(len(nodes), bool)).triangles
    corners = nodes[border]
    made = np.concatenate([nodes[np.unique(border)], corners.mean(axis=1)])
    made = np.concatenate([made, ((corners + np.roll(corners, 1, axis=1)) / 2).reshape(-1, 3)])
    comparisons = (
        (made, given, MAX_MESH_DISTANCE_EDGES * edge),
        (given.data, cKDTree(made), MAX_SURFACE_DISTANCE_EDGES * edge),
    )
    for points, others, limit in comparisons:
        away, _ = others.query(points)
        worst = int(away.argmax())
        if away[worst] > limit:
            place = ', '.join(f'{1e3 * x:.1f}' for x in points[worst])
            raise SessionError(
                f'{path}: the mesh would end {1e3 * away[worst]:.2g} mm from the surface, near '
                f'({place}) mm of the scene: the surface crosses itself there, or has a part '
                f'thinner than an edge of {1e3 * edge:.2g} mm; mend it, or take a smaller --edge'
            )


def _warnings(
    tetrahedra: int, worst: float, frame: Frame, surface: Surface, *, meshed: bool
) -> list[str]:
    """Return sentences; the remedy depends on whether the tetrahedra were made here."""
    warnings = []
    coarser = 'import it with a larger --edge' if meshed else 'make the mesh coarser'
    again = (
        'import it again, the mesher does not make the same mesh twice'
        if meshed
        else 'mend the mesh there'
    )
    if surface.size.max() > MAX_USUAL_SIZE_M:
        warnings.append(f'it is {surface.size.max():.2g} m long: is the unit right (--unit)?')
    if surface.parts > 1:
        warnings.append(f'the surface has {surface.parts} separate shells: is that meant?')
    if tetrahedra > MAX_REAL_TIME_TETRAHEDRA:
        warnings.append(
            f'{tetrahedra} tetrahedra: 30 Hz is not to be expected above '
            f'{MAX_REAL_TIME_TETRAHEDRA}; {coarser}'
        )
    if worst < 0.05:
        warnings.append(
            f'the worst element has the radius ratio {worst:.2g} and dictates the time step: '
            f'{again}'
        )
    if frame.slow_motion < 1:
        warnings.append(
            f'{frame.substeps} substeps do not suffice: it would run at {frame.slow_motion:.2g} of '
            f'its speed; {coarser}, or raise tissue.integration.max_substeps'
        )
    return warnings


def _print_report(report: Report, *, as_json: bool) -> None:
    if as_json:
        print(json.dumps(asdict(report), indent=2))
        return
    console = Console(soft_wrap=True, highlight=False)
    table = Table(box=box.SIMPLE, show_header=False, title=f'Mesh of {escape(report.surface)}')
    r = report
    for name, value in {
        'size': ' x '.join(f'{1e3 * x:.1f}' for x in r.size) + ' mm',
        'surface': f'closed, {r.parts} shell{"s" if r.parts > 1 else ""}',
        'nodes': f'{r.nodes}, {r.fixed_nodes} of them fixed',
        'tetrahedra': f'{r.tetrahedra}, edges of about {1e3 * r.edge:.2g} mm',
        'volume': f'{1e6 * r.mesh_volume:.4g} ml, '
        f'{100 * (r.mesh_volume / r.surface_volume - 1):+.1f} % against the surface; '
        f'least element {1e9 * r.least_volume:.2g} mm^3',
        'surface moved': f'by {1e3 * r.surface_moved:.2g} mm at most',
        'altitude': f'{1e3 * r.least_altitude:.2g} mm at least',
        'dihedral angle': f'{r.dihedral_least:.1f} deg at least; smallest of an element '
        f'{r.dihedral_median:.0f} deg in the median',
        'radius ratio': f'{r.radius_ratio_least:.2f} at least, {r.radius_ratio_median:.2f} median',
        'substeps': f'{r.substeps} a frame at 30 Hz',
    }.items():
        table.add_row(name, value)
    console.print(table)
    for sentence in r.mended:
        console.print(f'[yellow]mended:[/] {escape(sentence)}')
    for sentence in r.warnings:
        console.print(f'[yellow]warning:[/] {escape(sentence)}')
    console.print(f'wrote {escape(r.mesh)} and {escape(r.scene)}; to run it:')
    console.print(f'  ./trainer demo --scene {escape(r.scene)}')
