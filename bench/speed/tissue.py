"""Cost of a force evaluation, of a step and of a frame of the tissue."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit

from bench.common.clock import Figure, by_turns, figure, stream
from bench.common.meshes import PLANE_TOLERANCE_M, kuhn_block
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.coupling import NO_SPRINGS
from cutting_trainer.tissue_sim.contact.tool import indenter_contact
from cutting_trainer.tissue_sim.elasticity.elastic_force import internal_force
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ElasticModel, ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.integrators import INTEGRATORS, Integrator, IntegratorName
from cutting_trainer.tissue_sim.motion.stability import FrequencyBound, step_bound
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.streaming.messages import DeltaEncoder

BOX_SIZE_M = (0.10, 0.10, 0.04)
"""Size of the box, which is fixed at its underside."""
_WARM, _FRAMES = 8, 24
_DEPTH, _SLIDE_STEP = 1.3e-3, 2e-4
"""Depth of the press, and path along the surface in a frame [m]."""


def edge_of(tetrahedra: int) -> float:
    """Return edge of the bricks [m] of a box of about so many tetrahedra."""
    return float((6 * BOX_SIZE_M[0] * BOX_SIZE_M[1] * BOX_SIZE_M[2] / tetrahedra) ** (1 / 3))


def box(tetrahedra: int) -> TetMesh:
    """Return a box of about so many tetrahedra, its bricks nearly cubes."""
    edge = edge_of(tetrahedra)
    cells = (max(1, round(BOX_SIZE_M[0] / edge)), max(1, round(BOX_SIZE_M[1] / edge)))
    deep = max(1, round(tetrahedra / (6 * cells[0] * cells[1])))
    mesh = kuhn_block((*cells, deep), BOX_SIZE_M)
    return TetMesh(mesh.rest, mesh.tetrahedra, mesh.rest[:, 2] < PLANE_TOLERANCE_M)


TOUGHNESS, FREQUENCY_GROWTH = 30.0, 2.0
"""[J/m^2] at which a linear tissue is cut, and growth of its frequency by cuts."""


def liver_material() -> Material:
    """Return the material of the scene `liver`, with its damping, for linear models."""
    tissue = load_scene('liver').tissue
    m, d = tissue.material, tissue.damping
    return Material(m.youngs_modulus, m.poissons_ratio, m.density, d.alpha, d.beta)


@njit(cache=True)
def _evaluate(operands, u, f, rotation_steps, count):
    for _ in range(count):
        internal_force(operands, u, f, rotation_steps)


def moved_bytes(model: ElasticModel) -> int:
    """Return the bytes model of a force evaluation: it reads and writes each array once.

    A slot of the tensors is 9 numbers and a column, one of the domains 3 and a column; a node has
    its diagonal or volume, the places of its row, u read, f read and written, and set to 0 where
    there are no tensors. A corotational element has 15 numbers and 4 corners, and its rotation is
    written.
    """
    operands, n = model.operands(), model.mesh.node_count
    total = n * 24 * (3 if len(operands.rows.used) else 4)
    if len(operands.rows.used):
        total += int(operands.rows.used.sum()) * 76 + n * 64
    if len(operands.domains.used):
        total += int(operands.domains.used.sum()) * 28 + n * (24 + 64 * operands.rotating)
    return total + len(operands.elements.data) // 15 * (15 * 8 + 16 + 32)


def force(sizes: list[int]) -> list[Figure]:
    """Return one evaluation of each model, by tetrahedron, against streaming the same bytes."""
    figures = []
    for size in sizes:
        mesh = box(size)
        m = len(mesh.tetrahedra)
        u = 1e-4 * np.random.default_rng(0).standard_normal(3 * mesh.node_count)
        f = np.empty_like(u)
        for name in MODELS:
            model = ElasticModel(mesh, liver_material(), name)
            operands, count = model.operands(), max(1, 20_000 // m)
            amount = moved_bytes(model)
            times = by_turns(
                _evaluation(operands, u, f, int(model.rotating), count), stream(amount)
            )
            times[:, 0] /= count
            ratio = float(np.median(times[:, 0]) / np.median(times[:, 1]))
            against = f'reading {amount / m:.0f} bytes a tetrahedron'
            label = f'{name}, {m} tetrahedra'
            figures.append(figure(label, 'ns/tet', 1e9 / m * times[:, 0], ratio, against))
    return figures


def _evaluation(
    operands: Any, u: np.ndarray, f: np.ndarray, rotation_steps: int, count: int
) -> Callable[[], object]:
    return lambda: _evaluate(operands, u, f, rotation_steps, count)


def step(sizes: list[int]) -> list[Figure]:
    """Return a step of each integrator and model.

    Then frames of a palpation, whole and in parts.
    """
    figures = []
    for size in sizes:
        mesh = box(size)
        for name in MODELS:
            figures += _steps(mesh, name)
        for name in ('linear', 'linear_smoothed'):
            for nodes in (0, 2000, 1000):
                if nodes < mesh.node_count:
                    figures += palpation(size, name, nodes)
    return figures


def _steps(mesh: TetMesh, name: ModelName) -> list[Figure]:
    material, m = liver_material(), len(mesh.tetrahedra)
    model = ElasticModel(mesh, material, name)
    inverse = np.repeat(np.where(mesh.fixed == 1, 0.0, 1.0 / model.mass), 3)
    omega = FrequencyBound(model, inverse).omega
    tasks = []
    for integrator in INTEGRATORS:
        bound = step_bound(integrator, omega, material.alpha, material.beta)
        dt = 0.8 * bound if np.isfinite(bound) else 1 / 120
        tasks.append(steps_of(model, inverse, integrator, dt, 4))
    times = by_turns(*tasks, repeats=5) / 4
    base = INTEGRATORS.index('symplectic_euler')
    return [
        figure(
            f'{name}, {integrator}, {m} tetrahedra',
            'ns/tet',
            1e9 / m * times[:, i],
            float(np.median(times[:, i]) / np.median(times[:, base])),
            'symplectic_euler',
        )
        for i, integrator in enumerate(INTEGRATORS)
    ]


def steps_of(
    model: ElasticModel, inverse: np.ndarray, integrator: IntegratorName, dt: float, count: int
) -> Callable[[], None]:
    """Return a task: some steps of a free tissue that shakes.

    Args:
        model: of it.
        inverse: by coordinate, 0 where fixed [1/kg], shape (3 n,).
        integrator: which one.
        dt: [s].
        count: of steps.
    """
    method = Integrator(integrator, model.material.alpha, model.material.beta)
    spring, operands = NO_SPRINGS, model.operands()
    begin = 1e-5 * np.random.default_rng(0).standard_normal(len(inverse))
    begin[inverse == 0.0] = 0.0

    def steps() -> None:
        u, v = begin.copy(), np.zeros_like(begin)
        method.step(operands, inverse, model.diagonal, spring, u, v, dt, count)

    return steps


class _Part:
    """Accumulate the time of a method of an object."""

    def __init__(self, owner: Any, method: str) -> None:
        self.spent = 0.0
        self._called = getattr(owner, method)
        setattr(owner, method, self._timed)

    def _timed(self, *arguments: Any, **named: Any) -> Any:
        start = time.thread_time()
        try:
            return self._called(*arguments, **named)
        finally:
            self.spent += time.thread_time() - start


def palpation(size: int, name: ModelName, nodes: int) -> list[Figure]:
    """Return frames in which a tool presses and slides, at the planned step.

    Args:
        size: tetrahedra, about.
        name: of the model.
        nodes: that may move; 0: all.
    """
    tissue, mesh = load_scene('liver').tissue, box(size)
    resistance = Resistance(10.0, TOUGHNESS, tissue.material.blade_friction)
    simulation = TissueSimulation(
        mesh,
        liver_material(),
        resistance,
        model=name,
        stepping=TimeStepping('symplectic_euler', max_substeps=1000),
        active=ActiveSettings('budget', nodes) if nodes else ActiveSettings(),
    )
    encoder = DeltaEncoder(mesh, simulation.displacement)
    dynamics = simulation.dynamics
    parts = {
        'integrate': _Part(dynamics, '_integrate'),
        'choose the region': _Part(dynamics._active, 'choose'),
        'energy and guard': _Part(dynamics, '_motion'),
        'contact stiffness': _Part(simulation.tools[0]._stiffness, 'matrix'),
        'reaction': _Part(simulation.tools[0], 'reaction'),
        'encode': _Part(encoder, 'encode'),
    }
    rows = []
    for number in range(_WARM + _FRAMES):
        place = np.array([0.05 + _SLIDE_STEP * number, 0.05, BOX_SIZE_M[2]])
        depth = _DEPTH * min(number / _WARM, 1.0)
        contact = indenter_contact(mesh, place, np.array([0.0, 0.0, -1.0]), depth)
        before = [part.spent for part in parts.values()]
        start = time.thread_time()
        frame = simulation.frame(contact)
        encoder.encode(simulation.displacement, number, 0, None, 0)
        whole = time.thread_time() - start
        spent = [part.spent - old for part, old in zip(parts.values(), before, strict=True)]
        rows.append([whole, *spent])
    times = 1e3 * np.array(rows[_WARM:])
    some = f'{nodes} nodes move' if nodes else 'all nodes move'
    label = f'{name}, {len(mesh.tetrahedra)} tetrahedra, {some}'
    total = float(np.median(times[:, 0]))
    return [
        figure(f'frame, {label}', 'ms', times[:, 0]),
        figure(f'  substeps, {label}', '-', [frame.substeps]),
        *(
            figure(f'  {part}, {label}', 'ms', column, float(np.median(column)) / total, 'frame')
            for part, column in zip(parts, times.T[1:], strict=True)
        ),
    ]
