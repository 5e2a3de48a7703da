"""Yi 2007: recomputation of tables 4.1 and 4.2, and of the sessions of 7.5 and 7.6.

Run `python -m bench.accuracy.reproduction`: it prints the figures of docs/reproduction.md as JSON.
"""

import json
import time
from dataclasses import asdict, dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from bench.accuracy.integrator_limits import highest_mode, measured_limit
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.tissue_sim.contact.blade import Resistance, Sweep
from cutting_trainer.tissue_sim.contact.coupling import NO_SPRINGS
from cutting_trainer.tissue_sim.contact.tool import indenter_contact
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.mesh.topology import CUT
from cutting_trainer.tissue_sim.motion.integrators import Integrator, IntegratorName
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.planner.budget import Budget
from cutting_trainer.tissue_sim.planner.candidate import Task
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

Floats = NDArray[np.float64]

THESIS = Material(642.55, 0.47, 1050.0, 1e-5, 2e-5)
"""Section 7.2.2: alpha 1e-5 1/s, beta 2e-5 s, which it prints in "m * sec"."""
DOWN = np.array([0.0, 0.0, -1.0])
METHODS: tuple[IntegratorName, ...] = ('euler', 'rk4')
_JITTER = 0.12


@dataclass(frozen=True)
class Order:
    """Measured orders of the error of one step and of that after a fixed time (table 4.1)."""

    single: float
    total: float


@dataclass(frozen=True)
class Efficiency:
    """A row of table 4.2 [s]: largest step by theory and measured, CPU time of a step."""

    theory: float
    measured: float
    cpu: float


@dataclass(frozen=True)
class Palpation:
    """A tool pressed into the block (7.5).

    Attributes:
        depth: of the tool's tip below the surface [m], shape (k,).
        force: of the tissue on the tool when it has come to rest [N], shape (k,).
        cpu: of a frame [s].
        period: of a frame [s].
    """

    depth: Floats
    force: Floats
    cpu: float
    period: float


@dataclass(frozen=True)
class Cut:
    """A blade drawn through a block (7.6).

    Attributes:
        nodes, tetrahedra: before and after.
        lost: share of the volume.
        gap: mean width, lost volume over the area that the blade swept in the tissue [m].
        lag: largest distance that the opened surface stayed behind the blade [m].
        cpu: of a loop, cutting and a frame of motion, the median and the largest [s].
    """

    nodes: tuple[int, int]
    tetrahedra: tuple[int, int]
    lost: float
    gap: float
    lag: float
    cpu: tuple[float, float]


def thesis_block(
    cells: tuple[int, int, int], size: float, inner: int, seed: int, count: int
) -> TetMesh:
    """Return a block with as many nodes and tetrahedra as a printed one, whose coordinates are not
    known.

    The Delaunay mesh of a grid, moved a little within the faces and edges of the block so that no
    four nodes lie on a circle, and of some nodes inside.

    Args:
        cells: of the grid.
        size: of a cell [m].
        inner: nodes in the middles of cells beside those of the grid.
        seed: of the displacements; chosen for the number of tetrahedra and their quality.
        count: tetrahedra that it must have.

    Raises:
        ValueError: it has another number: the seed does not belong to this version of Qhull.
    """
    rng = np.random.default_rng(seed)
    grid = np.argwhere(np.ones([c + 1 for c in cells])).astype(float)
    shift = rng.uniform(-_JITTER, _JITTER, grid.shape)
    shift[(grid == 0) | (grid == cells)] = 0
    middles = np.argwhere(np.ones(cells)) + 0.5
    some = middles[rng.choice(len(middles), inner, replace=False)] if inner else middles[:0]
    nodes = np.concatenate([grid + shift, some + rng.uniform(-0.1, 0.1, some.shape)]) * size
    tets = Delaunay(nodes).simplices.astype(np.int64)
    a, b, c, d = (nodes[tets[:, i]] for i in range(4))
    volume = np.einsum('ij,ij->i', np.cross(b - a, c - a), d - a) / 6
    tets[volume < 0, 2:] = tets[volume < 0, :1:-1]
    tets = tets[abs(volume) > 1e-4 * size**3]
    if len(tets) != count:
        raise ValueError(f'the block has {len(tets)} tetrahedra, not {count}: try another seed')
    return TetMesh(nodes, tets, nodes[:, 2] < 1e-9)


def block_100() -> TetMesh:
    """Return 50 nodes and 100 tetrahedra of 1 cm.

    Of tables 4.2, 7.5 and the combined cut of 7.6.
    """
    return thesis_block((4, 4, 1), 0.01, 0, 3884, 100)


def block_258() -> TetMesh:
    """Return 85 nodes and 258 tetrahedra of 0.5 cm: of the cut by deletion in 7.6."""
    return thesis_block((4, 4, 2), 0.005, 10, 753, 258)


def orders(integrator: IntegratorName) -> Order:
    """Return the slopes of the errors of the undamped block, against its exact modal solution."""
    mesh = block_100()
    material = Material(THESIS.youngs_modulus, THESIS.poissons_ratio, THESIS.density)
    model = ElasticModel(mesh, material)
    inverse = np.repeat(np.where(mesh.fixed == 1, 0.0, 1 / model.mass), 3)
    free = inverse > 0
    root = np.sqrt(inverse[free])
    matrix = root[:, None] * model.dense()[np.ix_(free, free)] * root
    squares, modes = np.linalg.eigh(matrix)
    omega = np.sqrt(np.maximum(squares, 0.0))
    start = np.random.default_rng(0).normal(size=int(free.sum())) * 1e-4
    amplitudes = modes.T @ (start / root)

    def error(steps: int, dt: float) -> float:
        u, v = np.zeros(len(inverse)), np.zeros(len(inverse))
        u[free] = start
        spring = NO_SPRINGS
        method = Integrator(integrator, 0.0, 0.0)
        method.step(model.operands(), inverse, model.diagonal, spring, u, v, dt, steps)
        turn = omega * dt * steps
        exact = root * (modes @ (amplitudes * np.cos(turn)))
        speed = root * (modes @ (-amplitudes * omega * np.sin(turn)))
        # Of both: displacement alone is exact to one order more in a step from rest.
        wrong = np.concatenate([u[free] - exact, (v[free] - speed) / omega[-1]])
        return float(np.linalg.norm(wrong))

    dt = 0.05 / omega[-1]
    single = [error(1, dt / 2**k) for k in range(4)]
    total = [error(20 * 2**k, dt / 2**k) for k in range(4)]
    return Order(*(float(np.log2(e[-2] / e[-1])) for e in (single, total)))


def efficiency(integrator: IntegratorName, material: Material = THESIS) -> Efficiency:
    """Return a row of table 4.2 with stated parameters."""
    mesh = block_100()
    model = ElasticModel(mesh, material)
    task = Task(mesh, material, Resistance(1.0, 1.0, 0.0), Budget(), TimeStepping(integrator))
    limit = measured_limit(task, model, integrator, *highest_mode(model))
    inverse = np.repeat(np.where(mesh.fixed == 1, 0.0, 1 / model.mass), 3)
    u, v = np.full(len(inverse), 1e-6), np.zeros(len(inverse))
    method = Integrator(integrator, material.alpha, material.beta)
    operands, spring = model.operands(), NO_SPRINGS
    times = []
    for _ in range(31):
        start = time.thread_time()
        method.step(operands, inverse, model.diagonal, spring, u, v, 1e-6, 200)
        times.append((time.thread_time() - start) / 200)
    return Efficiency(limit.theory, limit.measured, float(np.median(times[1:])))


def palpation() -> Palpation:
    """Press 1 to 4 mm deep in the middle of the block, two seconds each, by RK4."""
    mesh = block_100()
    damped = Material(THESIS.youngs_modulus, THESIS.poissons_ratio, THESIS.density, 1.0, 3e-3)
    resistance = Resistance(10.0, 2.0, 1.0)  # above the force of the press: nothing is cut
    simulation = TissueSimulation(mesh, damped, resistance)
    middle = np.array([0.02, 0.02, 0.01])
    depths, forces, times = np.arange(1, 5) * 1e-3, [], []
    for depth in depths:
        for _ in range(60):
            contact = indenter_contact(mesh, middle, DOWN, float(depth))
            start = time.thread_time()
            frame = simulation.frame(contact)
            times.append(time.thread_time() - start)
        forces.append(float(frame.force[2]))
    return Palpation(depths, np.array(forces), float(np.median(times)), 1 / 30)


def drawn(method: str) -> Cut:
    """Draw a blade through a block along its middle, as the thesis does, by a method."""
    mesh = block_258() if method == 'delete' else block_100()
    length, width, height = mesh.rest.max(axis=0)
    volume, before = float(mesh.volumes().sum()), (mesh.node_count, len(mesh.tetrahedra))
    damped = Material(THESIS.youngs_modulus, THESIS.poissons_ratio, THESIS.density, 1.0, 3e-3)
    simulation = TissueSimulation(mesh, damped, Resistance(10.0, 2.0, 1.0))
    cutter = make_method(CuttingSettings.model_validate({'method': method}))
    y, bottom, top = 0.4 * width, -0.2 * height, 1.5 * height
    places = np.linspace(-0.1 * length, 0.8 * length, 46)
    path = [np.array([[x, y, top], [x, y, bottom]]) for x in places]
    times, lag = [], 0.0
    for a, b in pairwise(path):
        start = time.thread_time()
        result = cutter.advance(mesh, mesh.rest, Sweep(*a, *b))
        if not result.delta.empty:
            simulation.apply_cut(result.delta)
        simulation.frame(None)
        times.append(time.thread_time() - start)
        cut_faces = mesh.rest[mesh.triangles[mesh.triangle_kind == CUT]]
        reached = float(cut_faces[:, :, 0].max()) if len(cut_faces) else 0.0
        lag = max(lag, float(b[0, 0]) - reached)
    result = cutter.finish(mesh, mesh.rest)
    if not result.delta.empty:
        simulation.apply_cut(result.delta)
    lost = 1 - float(mesh.volumes().sum()) / volume
    area = 0.8 * length * height
    return Cut(
        (before[0], mesh.node_count),
        (before[1], len(mesh.tetrahedra)),
        lost,
        lost * volume / area,
        lag,
        (float(np.median(times)), float(max(times))),
    )


def main() -> None:
    """Print the figures of docs/reproduction.md as JSON, in SI units."""
    figures = {
        'orders': {name: asdict(orders(name)) for name in METHODS},
        'efficiency': {name: asdict(efficiency(name)) for name in METHODS},
        'highest_frequency': highest_mode(ElasticModel(block_100(), THESIS))[0],
        'palpation': asdict(palpation()),
        'cuts': {method: asdict(drawn(method)) for method in ('delete', 'combined')},
    }
    print(json.dumps(figures, indent=2, default=lambda x: np.asarray(x).tolist()))


if __name__ == '__main__':
    main()
