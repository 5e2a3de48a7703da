"""Bounds checks of an untrusted state.

Compiled kernels do not check indices: an index beyond an array would overwrite foreign memory.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from cutting_trainer.tissue_sim.contact.fracture import KNOTS, MAX_STRIPS
from cutting_trainer.tissue_sim.contact.friction import GrippingSprings
from cutting_trainer.tissue_sim.contact.immersion import POINTS
from cutting_trainer.tissue_sim.elasticity.adaptive_law import Law
from cutting_trainer.tissue_sim.elasticity.corotational import KEPT, Elements
from cutting_trainer.tissue_sim.elasticity.elastic_force import Operands
from cutting_trainer.tissue_sim.elasticity.local_rows import Locality
from cutting_trainer.tissue_sim.elasticity.nodal_smoothing import NodalSmoothing, SmoothingDomains
from cutting_trainer.tissue_sim.elasticity.rotation import LANES
from cutting_trainer.tissue_sim.elasticity.viscosity import ViscousNodes
from cutting_trainer.tissue_sim.elasticity.viscous_stress import KEPT as KEPT_OF_TERM
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.parallel_euler import MAX_THREADS, ParallelEuler
from cutting_trainer.tissue_sim.simulation.serialisation import StateError
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.simulation.tool_state import ToolState


def checked(check: Callable[[Any], None], made: object) -> None:
    """Run a check of an object rebuilt from a state.

    Raises:
        StateError: one sentence about any failure.
    """
    try:
        check(made)
    except (TypeError, ValueError, KeyError, IndexError, AttributeError) as error:
        raise StateError(f'the recorded state cannot be used: {error}') from None


def within(label: str, numbers: Any, limit: int, least: int = 0) -> None:
    """Refuse integers outside `least` to `limit` - 1.

    Raises:
        StateError: a number is out of range or no integer.
    """
    array = np.asarray(numbers)
    if array.dtype.kind not in 'iu':
        raise StateError(f'{label} has no whole numbers')
    if array.size and (int(array.min()) < least or int(array.max()) >= limit):
        worst = int(array.max()) if int(array.max()) >= limit else int(array.min())
        raise StateError(f'{label} has {worst}; allowed are {least} to {limit - 1}')


def has_room(label: str, array: np.ndarray, rows: int, *columns: int) -> None:
    """Refuse an array with too few rows, or with rows of another shape.

    Raises:
        StateError: the array is too small or has another shape.
    """
    if array.ndim != 1 + len(columns) or len(array) < rows or array.shape[1:] != columns:
        raise StateError(f'{label} has shape {array.shape} for {rows} rows of {columns}')


def check_mesh(mesh: TetMesh) -> None:
    """Refuse a mesh whose connectivity has an index out of range or a cycle.

    Raises:
        StateError: the first error.
    """
    links, n = mesh.links, mesh.node_count
    has_room('counts', links.counts, 3)
    m, k, logged = (int(count) for count in links.counts[:3])
    within('the counts of the mesh', [n, m, k, logged], 1 << 31)
    slots = len(links.tetrahedra)
    for name in ('tetrahedra', 'neighbors', 'face_triangle'):
        has_room(name, getattr(links, name), max(m, slots), 4)
    for name in ('corner_next', 'corner_prev'):
        has_room(name, getattr(links, name), max(4 * m, 4 * slots))
    for name, rows, *columns in (
        ('first_corner', n),
        ('triangles', k, 3),
        ('triangle_face', k),
        ('triangle_kind', k),
        ('log', logged),
        ('region', slots if len(links.region) else 0),
    ):
        has_room(name, getattr(links, name), rows, *columns)
    has_room('rest', mesh._rest, n, 3)
    has_room('fixed', mesh._fixed, n)
    corners, faces = mesh.tetrahedra.ravel(), mesh.neighbors.ravel()
    after, before = links.corner_next[: 4 * m], links.corner_prev[: 4 * m]
    triangle = links.face_triangle[:m].ravel()
    within('tetrahedra', corners, n)
    within('triangles', mesh.triangles, n)
    within('triangle_face', mesh.triangle_face, 4 * m)
    within('face_triangle', triangle, k, -1)
    within('log', links.log[:logged], 2 * max(slots, len(links.triangles)) + 2)
    for name, values in (
        ('neighbors', faces),
        ('corner_next', after),
        ('corner_prev', before),
        ('first_corner', links.first_corner[:n]),
    ):
        within(name, values, 4 * m, -1)
    every = np.arange(4 * m)
    first = links.first_corner[:n]
    heads = np.flatnonzero(first >= 0)
    for said, to, back in (
        ('neighbors', faces, faces),
        ('corner_next', after, before),
        ('corner_prev', before, after),
        ('face_triangle', triangle, mesh.triangle_face),
    ):
        linked = to >= 0
        if not np.array_equal(back[to[linked]], every[linked]):
            raise StateError(f'{said} does not lead back')
    if (before[first[heads]] >= 0).any() or not np.array_equal(corners[first[heads]], heads):
        raise StateError('first_corner is not where the corners of a node begin')
    if not np.array_equal(corners[after[after >= 0]], corners[after >= 0]):
        raise StateError('corner_next leads to another node')


def check_simulation(simulation: TissueSimulation) -> None:
    """Refuse a simulation whose kernels would leave their arrays.

    Raises:
        StateError: the first error.
    """
    mesh, dynamics = simulation.mesh, simulation.dynamics
    model = dynamics.model
    n = mesh.node_count
    check_mesh(mesh)
    meshes = (dynamics.mesh, model.mesh)
    parts: list[Any] = [model.tensor_mass, model._domains, model._elements, model._neighbours]
    inner = tuple(part._mesh for part in parts if part is not None)
    if any(other is not mesh for other in meshes + inner):
        raise StateError('its parts are of different meshes')
    mass = dynamics.masses
    owners = (mass, mass._frequency, mass._stiffened, dynamics._elastic, dynamics._active)
    if any(owner is not None and owner._model is not model for owner in owners):
        raise StateError('its parts are of different models')
    if dynamics.time_steps._mass is not mass:
        raise StateError('its time steps are of other masses')
    for name in ('_u', '_v'):
        has_room(name, getattr(dynamics, name), 3 * n)
    has_room('_inverse', mass._inverse, 3 * n)
    has_room('_inertia', mass._inertia, n)
    has_room('_pull', dynamics.cut_contact._pull, 0, 3)
    if dynamics.cut_contact._mesh is not mesh:
        raise StateError('the cut faces are of another tissue')
    if dynamics._loose is not None:
        within('_loose', dynamics._loose, n)
    _check_loads(dynamics, n)
    if mass._stiffened is not None:
        has_room('_linear', mass._stiffened._linear, n)
    regions = len(model.material.relative_stiffness)
    within('region', mesh.regions, regions)
    for tool in simulation.tools:
        if tool.blade is not None and len(tool._resistance.regions) + 1 < regions:
            raise StateError('regions of the tissue have no resistance to the blade')
    _check_model(model, n)
    _check_estimates(simulation, n)
    if dynamics._far is None:
        _check_region(dynamics._active, n)
    else:
        _check_far_field(dynamics, n)
    if not simulation.tools:
        raise StateError('it has no tool')
    for tool in simulation.tools:
        _check_tool(tool, dynamics, n)
    if simulation._left is not None:
        _check_blade(simulation._left, n)


def _check_loads(dynamics: Any, n: int) -> None:
    load = dynamics.model.load
    if load.shape not in ((0,), (3 * n,)):
        raise StateError(f'load has shape {load.shape} for {n} nodes')
    viscosity = None if dynamics.loads is None else dynamics.loads._viscosity
    if viscosity is None:
        return
    if viscosity._model is not dynamics.model or len(load) != 3 * n:
        raise StateError('the viscous state is of another tissue')
    terms = len(viscosity._series)
    has_room('_series', viscosity._series, terms, 2)
    has_room('_law', viscosity._law, 4)
    shapes: list[tuple[int, ...]] = [(KEPT_OF_TERM * terms,), (9,), (), (), (4,)]
    for name, columns in zip(ViscousNodes._fields, shapes, strict=True):
        has_room(name, getattr(viscosity.nodes, name), n, *columns)
    if viscosity._own is not None:
        _check_smoothing(viscosity._own, n)


def _check_model(model: Any, n: int) -> None:
    has_room('_mass', model._mass, n)
    has_room('_norms', model._norms, n)
    has_room('_diagonal', model._diagonal, 3 * n)
    if model.tensor_mass is not None:
        t = model.tensor_mass.tensors
        _check_rows('tensors', t, t.blocks, 9, n, 3 * n - 2)
        has_room('diagonal', t.diagonal, n, 6)
        _check_room('tensors', t, model.tensor_mass._filled, n)
    if isinstance(model._domains, NodalSmoothing):
        _check_smoothing(model._domains, n)
    if model._elements is not None:
        elements = model._elements
        within('elements', [elements._count], len(model.mesh.tetrahedra) + 1)
        _check_elements(elements._elements, 3 * n - 2)
        has_room('elements', elements._elements.corners, 4 * -(-elements._count // LANES) * LANES)
    if len(model._law.domains):
        _check_law(model._law)
    if model._neighbours is not None:
        rows = model._neighbours._rows
        _check_rows('neighbours', rows, rows.columns, 1, n, n)
        _check_room('neighbours', rows, model._neighbours._filled, n)
        has_room('_seen', model._neighbours._seen, n)


def _check_rows(label: str, rows: Any, values: np.ndarray, width: int, n: int, limit: int) -> None:
    """Refuse rows of n nodes whose used slots, or columns below a limit, are out of range."""
    slots = len(rows.columns)
    for name in ('start', 'used'):
        has_room(f'{name} of {label}', getattr(rows, name), n)
    start, used = rows.start[:n], rows.used[:n]
    within(f'start of {label}', start[used > 0], slots)
    within(f'used of {label}', used, slots + 1)
    within(f'the last slots of {label}', (start + used)[used > 0], slots + 1)
    has_room(f'values of {label}', values, width * slots)
    ends = np.cumsum(used)
    if n and int(ends[-1]) > slots:
        raise StateError(f'rows of {label} overlap')
    at = np.arange(int(ends[-1]) if n else 0) + np.repeat(start - ends + used, used)
    within(f'columns of {label}', rows.columns[at], limit)


def _check_room(label: str, rows: Any, filled: np.ndarray, n: int) -> None:
    """Refuse rows whose reserved slots are out of range."""
    slots = len(rows.columns)
    has_room(f'room of {label}', rows.room, n)
    has_room(f'filled of {label}', filled, 1)
    within(f'filled of {label}', filled, slots + 1)
    room = rows.room[:n]
    within(f'room of {label}', room, slots + 1)
    within(f'the room of {label}', (rows.start[:n] + room)[room > 0], slots + 1)
    if (rows.used[:n] > room).any():
        raise StateError(f'a row of {label} is longer than its room')


def _check_smoothing(smoothing: NodalSmoothing, n: int) -> None:
    within('nodes of domains', [smoothing._nodes], n + 1, n)
    within('regions of nodes', smoothing._others, 256 * n)
    _check_domains(smoothing._domains, smoothing.count, 3 * n - 2)
    _check_room('domains', smoothing._domains, smoothing._filled, smoothing.count)


def _check_domains(domains: SmoothingDomains, n: int, limit: int) -> None:
    _check_rows('domains', domains, domains.vectors, 3, n, limit)
    has_room('volume', domains.volume, n)
    has_room('rotation', domains.rotation, n, 4)
    has_room('lame', domains.lame, 2)


def _check_elements(elements: Elements, limit: int) -> None:
    within('corners', elements.corners, max(limit, 1))
    chunks = len(elements.corners) // (4 * LANES)
    has_room('data', elements.data, KEPT * LANES * chunks)


def _check_law(law: Law) -> None:
    for name, length in (('domains', 4), ('elements', 4), ('tolerance', 2), ('implicit', 1)):
        has_room(f'{name} of the law', getattr(law, name), length)


def _check_law_operands(operands: Operands) -> None:
    law = operands.law
    _check_law(law)
    nodes, slots = len(operands.domains.used), len(operands.elements.corners) // 4
    has_room('domain_bounds', law.domain_bounds, nodes)
    has_room('element_bounds', law.element_bounds, slots)
    has_room('counters', law.counters, 2)
    has_room('candidates', law.candidates, len(operands.chunks) * LANES)
    within('counters', law.counters, len(law.candidates) + LANES, -1)
    within('the number of candidates', law.counters[1:2], len(law.candidates) + 1)
    within('candidates', law.candidates, max(slots, 1))


def _check_estimates(simulation: TissueSimulation, n: int) -> None:
    """Check the estimates of frequency and compliance, and the integrator."""
    dynamics = simulation.dynamics
    has_room('_f', dynamics.masses._frequency._f, 0)
    integrator: Any = dynamics._integrator
    has_room('_work', integrator._work, 7, *integrator._work.shape[1:])
    has_room('_damping', integrator._damping, 2)
    if isinstance(integrator, ParallelEuler):
        has_room('_threads', np.array(integrator._threads)[None], 1)
        within('_threads', integrator._threads, MAX_THREADS + 1, 2)
        if 'min_nodes' in vars(integrator):
            raise StateError('min_nodes is not to be chosen by a state')


def _check_far_field(dynamics: Any, n: int) -> None:
    far = dynamics._far
    grid, stiffness, model = far._grid, far._stiffness, dynamics.model
    if dynamics._active is not far or stiffness._model is not model:
        raise StateError('the far field is of another tissue')
    if stiffness._grid is not grid or grid._mesh is not model.mesh:
        raise StateError('the far field has another grid')
    if grid._neighbours is not model._neighbours:
        raise StateError('the grid has the neighbours of another tissue')
    has_room('_shape', grid._shape, 3)
    within('_shape', grid._shape, 1 << 20, 2)
    has_room('_cell', grid._cell, n, 3)
    for axis in range(3):
        within('_cell', grid._cell[:n, axis], int(grid._shape[axis]) - 1)
    has_room('columns', grid.columns, n, 8)
    has_room('weights', grid.weights, n, 8)
    within('columns', grid.columns[:n], grid.count, -1)
    if (grid.weights[:n][grid.columns[:n] < 0] != 0.0).any():
        raise StateError('a node follows an unknown that is none')
    count, slots = len(stiffness.used), len(stiffness.neighbours)
    within('unknowns', [count], grid.count + 1)
    room = slots // max(count, 1)
    if slots != room * count:
        raise StateError(f'{count} unknowns share {slots} slots')
    within('used', stiffness.used, room + 1)
    within('neighbours', stiffness.neighbours, max(3 * count, 1))
    has_room('blocks', stiffness.blocks, 9 * slots + 1)
    has_room('_level', far._level, n)
    has_room('_ring', far._ring, n)
    within('_far', far._far, n)
    has_room('_centres', far._centres, 0, 3)
    has_room('_mass', far._mass, 0)
    within('_mass', [len(far._mass)], grid.count + 1)


def _check_region(active: Any, n: int) -> None:
    if active.whole:
        return
    has_room('_quiet', active._quiet, n)
    within('_awake', active._awake, n)
    within('_near', active._near, n)
    scratch = active._scratch
    has_room('_scratch', scratch, 2, *scratch.shape[1:])
    if (region := active._region) is None:
        return
    size = n
    if region.place is not None:
        size = _check_place(region.place, n)
    within('spans', region.spans, size + 1)
    has_room('spans', region.spans, 0, 2)
    _check_operands(region.operands, size)
    _check_operands(region.around, n)


def _check_place(place: Locality, n: int) -> int:
    size = len(place.at) // 3
    within('at', place.at, 3 * n)
    has_room('local', place.local, n)
    within('local', place.local, size, -1)
    within('moving', [place.moving], size + 1)
    return size


def _check_operands(operands: Operands, size: int) -> None:
    """Refuse operands for the force on `size` nodes with an index out of range."""
    limit = 3 * size - 2
    rows, local = operands.rows, operands.local
    if len(rows.used):
        _check_rows('rows', rows, rows.blocks, 9, len(rows.used), limit)
        has_room('diagonal of rows', rows.diagonal, 6 * len(rows.used))
        within('nodes of rows', [len(rows.used)], size + 1)
    if len(operands.domains.used):
        _check_domains(operands.domains, len(operands.domains.used), limit)
    has_room('spans', operands.spans, 0, 2)
    within('spans', operands.spans, (len(operands.domains.used) or size) + 1)
    if len(operands.elements.corners):
        _check_elements(operands.elements, limit)
    if len(operands.law.domains):
        _check_law_operands(operands)
    within('chunks', operands.chunks, len(operands.elements.corners) // (4 * LANES))
    for name, spans in (('awake', operands.awake), ('reach', operands.reach)):
        has_room(name, spans, 0, 2)
        within(name, spans, size + 1)
    if len(local.first):
        slots = len(local.columns)
        within('first', local.first, slots + 1)
        within('local columns', local.columns, limit)
        within('local rows', [len(local.first)], size + 2)
        has_room('local blocks', local.blocks, 9 * slots + 1)


def _check_tool(tool: ToolState, dynamics: Dynamics, n: int) -> None:
    """Check a tool's springs, and that points have three coordinates."""
    stiffness: Any = tool._stiffness
    springs: Any = tool._springs
    if tool._dynamics is not dynamics or stiffness._dynamics is not dynamics:
        raise StateError('a tool is in another tissue')
    if stiffness._springs is not springs:
        raise StateError('the stiffness is that of other springs')
    for point in (stiffness._here, stiffness._ahead, getattr(stiffness, '_beside', None)):
        if point is None:
            continue
        if point._topology == dynamics.mesh.topology:
            within('_patch', point._patch, n)
            has_room('_x', point._x, 0, 3 * n)
            has_room('_held', point._held, 5, 3 * n)
    if springs._footprints is not None:
        has_room('_sizes', springs._footprints._sizes, n, 1)
    if isinstance(springs, GrippingSprings):
        has_room('_stretch', springs._stretch, 3)
    has_room('tip of the dent', tool._dent.tip, 3)
    for name in ('_target', '_device', '_moved'):
        place = getattr(tool, name)
        if place is not None:
            has_room(name, place, 3)
    if (grip := tool._grip) is not None:
        within('nodes of the grip', grip.nodes, n)
        if len(grip.nodes) == 0 or grip.weights.shape != grip.nodes.shape:
            raise StateError(
                f'{len(grip.nodes)} nodes of the grip have {len(grip.weights)} weights'
            )
        for name in ('offset', 'end', 'normal'):
            has_room(f'{name} of the grip', getattr(grip, name), 3)
    if tool._edge is not None:
        has_room('_edge', tool._edge, 2, 3)
    if tool.blade is not None:
        _check_blade(tool.blade, n)


def _check_blade(blade: Any, n: int) -> None:
    edge, strips = blade._state, blade._strips
    for name, width in (('points', 3), ('corners', 4), ('weights', 4)):
        has_room(f'{name} of the edge', getattr(edge, name), POINTS, width)
    has_room('spans of the edge', edge.spans, POINTS)
    has_room('running of the edge', edge.running, 2)
    has_room('rigidity of the blade', blade._law.rigidity, 3, 3)
    has_room('hint of the edge', edge.hint, 1)
    has_room('region of the edge', edge.region, POINTS)
    within('region of the edge', edge.region, len(blade._law.toughness))
    for name in ('friction', 'at_tip'):
        has_room(f'{name} of the blade', getattr(blade._law, name), len(blade._law.toughness))
    within('corners of the blade', edge.corners, n)
    has_room('strips of the blade', strips.knots, MAX_STRIPS, 2, KNOTS, 3)
    has_room('counts of the strips', strips.counts, 2)
    within('the number of strips', strips.counts, MAX_STRIPS + 1)
    for name in ('_from', '_to'):
        if (anchor := getattr(blade, name)) is not None:
            count = len(anchor.shares)
            within(f'corners of {name}', anchor.corners, n)
            has_room(f'corners of {name}', anchor.corners, count, 4)
            has_room(f'weights of {name}', anchor.weights, count, 4)
            has_room(f'points of {name}', anchor.points, count, 3)
    has_room('_device', blade._device, 2, 3)
    has_room('_moved', blade._moved, POINTS, 3)
    for name in ('_tip', '_edge', '_cut_tip', '_cut_edge', 'force'):
        has_room(name, getattr(blade, name), 3)
    has_room('torque', blade.turning.torque, 3)
    has_room('immersed', blade.turning.immersed, 2)
